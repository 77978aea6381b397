"""Compiled loops of the environment: actions to commands, and states to rewards."""

from __future__ import annotations

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, IntArray


@compiled
def read_actions(
    actions: FloatArray, entry: IntArray, column: IntArray, owner: IntArray, command: FloatArray, clipped: IntArray
) -> int:
    """Clip actions to [-1, 1] and write them into `command` (m, B); count what was clipped.

    Args:
        actions: (B, A) all agents' actions of each environment, side by side.
        entry: (C,) which entry of an environment's actions is read.
        column: (C,) the input it becomes.
        owner: (C,) number of the agent whose it is.
        command: (m, B) overwritten at `column`.
        clipped: (B, N) added to.

    Returns:
        -1, or where the first action is that isn't finite: environment * C + place in `entry`. Nothing is written then.
    """
    for env in range(actions.shape[0]):
        for q in range(entry.size):
            value = actions[env, entry[q]]
            if not np.isfinite(value):
                return env * entry.size + q
    for env in range(actions.shape[0]):
        for q in range(entry.size):
            value = actions[env, entry[q]]
            if value > 1.0:
                value = 1.0
                clipped[env, owner[q]] += 1
            elif value < -1.0:
                value = -1.0
                clipped[env, owner[q]] += 1
            command[column[q], env] = value
    return -1


@compiled
def judge(
    agent: IntArray,
    own: IntArray,
    other: IntArray,
    displacement: FloatArray,
    weight: FloatArray,
    x: FloatArray,
    input_owner: IntArray,
    u: FloatArray,
    scale: tuple[float, float],
    extremes: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    cost: FloatArray,
    reward: FloatArray,
    info: FloatArray,
) -> None:
    """Write every agent's reward, its root mean square error along its task edges, and the observers' extremes.

    Args:
        agent: (E,) number of the agent that an edge belongs to.
        own: (E, d) its position in the states.
        other: (E, d) the other's.
        displacement: (E, d) what p_other - p_own should be, in m.
        weight: (E,) one over the number of the agent's edges.
        x: (n, B) states.
        input_owner: (m,) number of the agent whose input it is, -1 for leaders.
        u: (m, B) inputs as fractions of their limits.
        scale: control period in s, and the weight of the squared inputs in m^2.
        extremes: (B,) each: largest |xi| / rho, |x_tilde| / delta, |mu| / omega, |g_tilde| / theta.
        cost: (2, N, B) scratch.
        reward: (B, N) overwritten with -period * (mean square error + weight * |u|^2).
        info: (3, B, N) overwritten with the task error in m, the largest disagreement and the largest error, each as a
            fraction of its bound.
    """
    cost[:] = 0.0
    for edge in range(agent.size):
        for c in range(own.shape[1]):
            for env in range(x.shape[1]):
                miss = x[other[edge, c], env] - x[own[edge, c], env] - displacement[edge, c]
                cost[0, agent[edge], env] += weight[edge] * miss * miss
    for column in range(input_owner.size):
        if input_owner[column] >= 0:
            for env in range(u.shape[1]):
                cost[1, input_owner[column], env] += u[column, env] * u[column, env]
    for env in range(reward.shape[0]):
        for i in range(reward.shape[1]):
            reward[env, i] = -scale[0] * (cost[0, i, env] + scale[1] * cost[1, i, env])
            info[0, env, i] = np.sqrt(cost[0, i, env])
            info[1, env, i] = max(extremes[0][env], extremes[2][env])
            info[2, env, i] = max(extremes[1][env], extremes[3][env])
