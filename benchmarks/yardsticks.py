"""Compiled references for the proximal step: a bare loop, and the explicit step of `paper`."""

from __future__ import annotations

from typing import Any

import numpy as np

from agents.consensus import TanhConsensus
from khop_env.compiled import compiled
from khop_env.elementary import log_ratio
from khop_env.observers import FloatArray
from khop_env.observers.disagreement import correction, disagreement
from khop_env.observers.performance import exponentials
from khop_env.physics.right_hand_sides import drifter_drift
from khop_env.physics.waveforms import add_sines
from khop_env.simulation import Simulator
from khop_env.simulation.edge_law import displacements, sum_edges


@compiled
def bare_loop(e: FloatArray, slope: FloatArray, curvature: FloatArray, repeats: int) -> None:
    """Phi' (with T) and phi'' once per element and nothing else: the evaluations that any solver needs."""
    for _ in range(repeats):
        for q in range(e.size):
            transformed = log_ratio(e[q])
            weight = 1.0 / ((1.0 - e[q]) * (1.0 + e[q]))
            slope[q] = 2.0 * transformed * weight
            curvature[q] = 4.0 * (1.0 + e[q] * transformed) * weight * weight


@compiled
def closed_loop_derivative(
    states: Any, inputs: Any, funnels: Any, sines: Any, law: Any, t: FloatArray, z: Any, dz: Any, work: Any
) -> None:
    """Write the rates of x, x_hat and g_hat of `paper` into `dz`, by the compiled functions of the simulator."""
    x, y, ghat = z
    dx, dy, dghat = dz
    terms, u, e, xi, rho, w = work
    displacements(law[2], law[3], law[4], x, y, terms, 0, t.size)
    sum_edges(law[0], True, law[1], terms, u, 0, t.size)
    g = u.reshape(x.shape)
    drifter_drift(x.shape[0] // 2, 0, x, dx, 0, t.size)
    w[:] = 0.0
    add_sines(t, sines[0], 0, 1, sines[1], sines[2], w, 0, t.size)
    for column in range(x.shape[0]):
        for env in range(x.shape[1]):
            dx[column, env] += g[column, env] + w[column, env]
    exponentials(t, funnels[3], funnels[4], funnels[5], rho, 0, t.size)
    disagreement(inputs, ghat, g, xi)
    correction(inputs, xi, rho, e, dghat)
    exponentials(t, funnels[0], funnels[1], funnels[2], rho, 0, t.size)
    disagreement(states, y, x, xi)
    correction(states, xi, rho, e, dy)
    drifter_drift(y.shape[0] // 2, 0, y, xi, 0, t.size)
    for column in range(y.shape[0]):
        for env in range(y.shape[1]):
            dy[column, env] += xi[column, env] + ghat[column, env]


@compiled
def explicit_steps(
    states: Any,
    inputs: Any,
    funnels: Any,
    sines: Any,
    law: Any,
    t: Any,
    z: Any,
    dz: Any,
    work: Any,
    dt: float,
    steps: int,
) -> None:
    """Forward Euler, all steps in one compiled call, in place."""
    for _ in range(steps):
        closed_loop_derivative(states, inputs, funnels, sines, law, t, z, dz, work)
        for env in range(t.size):
            t[env] += dt
        for block in range(3):
            values, rates = z[block].reshape(-1), dz[block].reshape(-1)
            for q in range(values.size):
                values[q] += dt * rates[q]


class CompiledPaper:
    """The closed loop of the `paper` scenario without any Python in it.

    Args:
        simulator: built from `paper` with its law; the loop starts from its state, which isn't changed.
    """

    def __init__(self, simulator: Simulator) -> None:
        plant, state, design = simulator.plant, simulator.state, simulator.design
        views, law = plant.views, plant.law
        assert views is not None
        assert isinstance(law, TanhConsensus)
        assert plant.disturbance is not None
        edges = views.edge_arrays()
        assert edges is not None
        _, channels, part = plant.disturbance._parts[0]
        pairs, batch = design.states.layout.size, simulator.num_envs
        self.t = state.t.copy()
        self.z = (state.x.copy(), state.memory["estimate"].copy(), state.memory["input_estimate"].copy())
        self._dz = tuple(np.zeros_like(block) for block in self.z)
        self._constants = (
            design.states.layout.arrays,
            design.inputs.layout.arrays,
            (*design.states.rho.coefficients, *design.inputs.rho.coefficients),
            (np.ascontiguousarray(state.drawn[:, part]), channels.index, channels.amplitude),
            (law.gain, edges.agent, edges.kind, edges.own, edges.other),
        )
        self._work = (
            np.zeros((len(views.view.edges), 2, batch)),
            np.zeros((len(simulator.fleet), 2, batch)),
            *(np.zeros((pairs, batch)) for _ in range(2)),
            np.zeros((design.states.layout.rows, batch)),
            np.zeros((simulator.fleet.n, batch)),
        )

    def run(self, dt: float, steps: int) -> None:
        """Take `steps` explicit steps of `dt` seconds."""
        explicit_steps(*self._constants, self.t, self.z, self._dz, self._work, dt, steps)

    def derivative(self, t: float, flat: FloatArray) -> FloatArray:
        """The right-hand side for SciPy, with num_envs = 1: all three blocks in one vector."""
        cuts = np.cumsum([block.size for block in self.z])
        blocks = tuple(np.ascontiguousarray(part)[:, None] for part in np.split(flat, cuts[:-1]))
        closed_loop_derivative(*self._constants, np.array([t]), blocks, self._dz, self._work)
        return np.concatenate([rate[:, 0] for rate in self._dz])
