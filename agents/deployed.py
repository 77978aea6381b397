"""A policy in the process of one agent (`khop deploy`), and what became of the task afterwards."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from agents.outcomes import Outcomes
from agents.policy import by_agent, describe, policy_seeds
from agents.running import PolicyRun, policy_and_environment
from khop_env.env import Direct
from khop_env.network import Network
from khop_env.observers import Estimate, FloatArray
from khop_env.results.metrics import finite
from khop_env.scenarios import Scenario

PLACE = "agents.deployed:PolicyControl"


class PolicyControl:
    """A policy for one agent: a `khop_env.deploy.control.Control`.

    It has an environment of its own, which is never stepped. What the agent knows is written into it: its own state,
    its own part of the task (its goal), and its node's estimates; so it observes by the environment's own code.
    Everything else there is zeros, or has never arrived, and what the policy chooses for others is of no use. Random
    numbers are drawn for all agents in every process, as in the environment, so that a policy that draws some acts the
    same.

    Args:
        scenario: that is run.
        agent: index of this one.
        network: over which messages go.
        estimator: its name.
        spec: of the policy, as for `agents.make_policy`.
        environment: in which it acts.
        seed: of the episode.
        memory: by name arrays of the task, as `policy_setups` has them.

    Raises:
        ValueError: for a policy that doesn't fit.
    """

    def __init__(
        self,
        scenario: Scenario,
        agent: int,
        *,
        network: Network,
        estimator: str,
        spec: str,
        environment: str,
        seed: int,
        memory: Mapping[str, Any],
    ) -> None:
        arguments = {"network": network, "estimator": estimator}
        self._policy, env = policy_and_environment(
            spec, scenario, "estimate", None, environment=environment, arguments=arguments
        )
        batched = self._batched = env.batched
        fleet, layout = batched.fleet, batched.simulator.observers.layout
        self._spec, self._id = spec, fleet.ids[agent]
        self._own, self._scale = fleet.state_slice(agent), fleet.input_limit[fleet.input_slice(agent)]
        self._period = batched.settings.control_period
        self._slots = []
        for (observer, target), first in layout.slot.items():
            if observer == agent:
                place = slice(first, first + fleet.models[target].n)
                self._slots.append((fleet.ids[target], place, int(layout.column_pair[first])))
        description, seeds = describe(env), policy_seeds([seed])
        self._policy.reset(description, seeds)
        self._forget()
        self._policy.act(self._observations())  # compiles what it runs, before the first round
        self._policy.reset(description, seeds)
        for name, values in memory.items():
            whole, own = batched.task.memory[name], np.array(values, np.float64)
            if _by_agents(whole, len(fleet)):
                whole[agent] = own
            else:
                whole[...] = own
        self._cycle, self._u = -1, np.zeros(len(self._scale))

    def __call__(self, t: float, x: FloatArray, estimates: Mapping[str, Estimate]) -> FloatArray:
        """The policy's input, which is chosen once in a control period.

        Raises:
            ValueError: for an action that is missing, misshapen, or not finite.
        """
        cycle = math.floor(t / self._period + 1e-6)
        if cycle > self._cycle:
            self._cycle = cycle
            self._know(t, x, estimates)
            self._u = self._input(self._policy.act(self._observations()))
        return self._u

    def _know(self, t: float, x: FloatArray, estimates: Mapping[str, Estimate]) -> None:
        state = self._batched.simulator.state
        memory = state.memory
        state.t[0], state.x[self._own, 0] = t, x
        for target, place, pair in self._slots:
            known = estimates[target]
            memory["estimate"][place, 0], memory["bound"][place, 0] = known.estimate, known.bound
            arrived = known.hops > 0
            memory["stamp"][pair, 0] = t - known.age if arrived else -1.0
            memory["arrived"][pair, 0] = t - known.since if arrived else -1.0
            memory["hops"][pair, 0] = known.hops

    def _forget(self) -> None:
        """Nothing is known: a new environment holds an episode."""
        state = self._batched.simulator.state
        state.x[...] = 0.0
        for name in ("estimate", "hops"):
            state.memory[name][...] = 0.0
        for name in ("stamp", "arrived"):
            state.memory[name][...] = -1.0
        state.memory["bound"][...] = np.inf

    def _observations(self) -> dict[str, Any]:
        found = by_agent(self._batched, self._batched.observations())
        return {agent: values[0] for agent, values in found.items()}

    def _input(self, actions: Mapping[str, Any]) -> FloatArray:
        inputs = len(self._scale)
        try:
            action = np.asarray(actions[self._id], np.float64)[:inputs]
        except (KeyError, TypeError, ValueError, IndexError):
            raise ValueError(f"policy {self._spec!r} has no action for {self._id!r}, {inputs} numbers") from None
        if action.shape != (inputs,) or not np.isfinite(action).all():
            raise ValueError(
                f"policy {self._spec!r}: the action of {self._id!r} must be {inputs} finite numbers; got "
                f"{action.tolist()}"
            )
        return np.clip(action, -1.0, 1.0) * self._scale


def steps_of(played: PolicyRun, period: float) -> int:
    """Steps of the plant in a period of messages, where a policy plays an environment.

    Raises:
        ValueError: for an environment that processes can't play.
    """
    batched, name = played.env.batched, played.name
    settings, fleet = batched.settings, batched.fleet
    if settings.message_size:
        raise ValueError(
            f"--controller {name}: it adds {settings.message_size} numbers of its own to messages, and a node's "
            "messages have none; leave announce out (khop run plays it)"
        )
    if not isinstance(settings.actuator, Direct):
        raise ValueError(
            f"--controller {name}: it acts through {settings.actuator!r}, and a process holds inputs; see khop run"
        )
    if len(batched.agents) < len(fleet):
        driven = [each for each in fleet.ids if each not in batched.agents]
        raise ValueError(
            f"--controller {name}: {batched.task.environment} moves {', '.join(driven)} itself; khop deploy runs "
            "policies only where every agent acts, see khop run"
        )
    h = settings.control_period / describe(played.env).steps
    steps = round(period / h)
    if steps < 1 or abs(steps * h - period) > 1e-9 * period:
        raise ValueError(
            f"--controller {name}: it acts every {settings.control_period:g} s, in plant steps of {h:g} s, of which "
            f"the period of messages, {period:g} s, isn't a multiple; --network ...:period={settings.control_period:g}"
        )
    return steps


def policy_setups(played: PolicyRun, seed: int) -> list[dict[str, Any]]:
    """What each agent's process has to know of a policy at the beginning of an episode, as JSON has it."""
    batched = played.env.batched
    shared = {"make": PLACE, "spec": played.name, "environment": batched.task.environment, "seed": seed}
    found = []
    for agent in range(len(batched.fleet)):
        memory = {
            name: (values[agent] if _by_agents(values, len(batched.fleet)) else values).tolist()
            for name, values in batched.task.memory.items()
        }
        found.append({**shared, "memory": memory})
    return found


def result_of(played: PolicyRun, x: FloatArray, u: FloatArray, steps: int) -> dict[str, Any]:
    """What became of the task until the end of a run; agents may have gone on after the task's.

    Args:
        played: at the beginning of the same episode.
        x: (T + 1, n) true states after each step of the plant.
        u: (T + 1, m) inputs from then on.
        steps: of the plant in a control period.

    Returns:
        As a summary of `khop run` has it: environment, return, final_task_error and its unit, terminated, and outcomes
        where agents may collide. What a filter has changed isn't known.
    """
    batched = played.env.batched
    task, world, substeps = batched.task, batched.world, batched.settings.substeps
    cycles, parts = (len(x) - 1) // steps, steps // substeps
    outcomes, total = Outcomes(batched, task.evaluate(world).infos), 0.0
    for cycle in range(1, cycles + 1):
        first = (cycle - 1) * steps
        for number in range(substeps):
            row = first + number * parts
            world.inputs[:, 0] = u[row] / np.where(np.isfinite(batched.fleet.input_limit), batched.fleet.input_limit, 1)
            world.t[0], world.x[:, 0] = cycle * world.control_period, x[row + parts]
            task.moved(world, number)
        found = task.evaluate(world)
        total += float(found.reward.mean())
        everywhere, over = np.ones(1, np.bool_), np.array([cycle == cycles])
        outcomes.add(cycle, everywhere, over, found.infos, played.policy)
    values = {name: finite(float(each[0])) for name, each in outcomes.result().items()}
    return {
        "environment": task.environment,
        "return": finite(total),
        "final_task_error": finite(float(batched.task_errors().mean())),
        "task_error_unit": task.error_unit(world),
        "terminated": False,
        **({"outcomes": {**values, "intervention": None, "infeasible": None}} if values else {}),
    }


def _by_agents(values: FloatArray, agents: int) -> bool:
    return len(values) == agents
