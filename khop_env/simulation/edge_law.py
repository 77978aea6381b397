"""Laws along task edges in compiled code: from displacements to the inputs of the library's models."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from khop_env.compiled import compiled, inlined, place
from khop_env.elementary import tanh
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import Fleet
from khop_env.physics.right_hand_sides import DRIFTER, Runs, drifts, velocity_inputs
from khop_env.physics.velocity import VELOCITY_CONTROLLERS

HELD, TANH, LINEAR, LIMITED_MEAN, SHRUNK_MEAN = range(-1, 4)
_CONTROLLERS = dict(VELOCITY_CONTROLLERS)  # the library's own, whose compiled form this is


class EdgeLaw(NamedTuple):
    """The compiled form of a law along task edges, and its parameters; d are the displacements of known edges.

    Attributes:
        kind: TANH: v = gain sum tanh(d). LINEAR: v = gain sum d. LIMITED_MEAN: v = mean of gain d, its norm limited to
            `second`. SHRUNK_MEAN: v = gain (second q - p), q the mean of d plus the own position p. HELD: no law.
        gain: in 1/s.
        second: in m/s, or without unit.
        cancel_drift: whether agents whose input is a velocity subtract their own drift.
        clip: whether inputs are clipped at the limits.
    """

    kind: int
    gain: float = 0.0
    second: float = 0.0
    cancel_drift: bool = False
    clip: bool = True


class EdgeArrays(NamedTuple):
    """Task edges, and where the displacements along them come from, for the compiled loop.

    Attributes:
        kind: (E,) of the source: 0 for the other's state, 1 for its estimate, 2 for none.
        own: (E, d) rows of the own position.
        other: (E, d) rows of the other's, among the states or the estimates.
        agent: (E,) whose edge it is.
        known: (N,) number of each agent's edges with a source.
        edges: (N,) number of its edges.
        position: (N, d) rows of all positions.
        limit: (m,) the input limits.
    """

    kind: IntArray
    own: IntArray
    other: IntArray
    agent: IntArray
    known: IntArray
    edges: IntArray
    position: IntArray
    limit: FloatArray

    @classmethod
    def of(cls, fleet: Fleet, edges: IntArray, kind: IntArray, own: IntArray, other: IntArray) -> EdgeArrays:
        """Of directed edges (E, 2) and the sources of their displacements."""
        agent, count = np.ascontiguousarray(edges[:, 0]), len(fleet)
        return cls(
            kind,
            own,
            other,
            agent,
            np.bincount(agent[kind < 2], minlength=count),
            np.bincount(agent, minlength=count),
            np.ascontiguousarray(fleet.position_index),
            fleet.input_limit,
        )

    @classmethod
    def none(cls, fleet: Fleet) -> EdgeArrays:
        """Without edges, where there is no law."""
        nothing = np.zeros((0, fleet.position_dim), np.int64)
        return cls.of(fleet, np.zeros((0, 2), np.int64), np.zeros(0, np.int64), nothing, nothing)


def compiled_law(law: object) -> EdgeLaw | None:
    """A law's compiled form, from its method `edge_law`; None for laws without one."""
    method = getattr(law, "edge_law", None)
    return None if method is None else method()


def has_compiled_controllers(fleet: Fleet) -> bool:
    """Whether commanded velocities become inputs by the library's own controllers."""
    return all(
        group.model.form is not None
        and group.model.type in _CONTROLLERS
        and VELOCITY_CONTROLLERS.get(group.model.type) is _CONTROLLERS[group.model.type]
        for group in fleet.groups
    )


@compiled
def command_inputs(
    law: Any,
    edges: Any,
    runs: Any,
    x: FloatArray,
    estimate: FloatArray,
    u: FloatArray,
    terms: FloatArray,
    velocity: FloatArray,
    drift: FloatArray,
    low: int,
    high: int,
) -> None:
    """Write the law's inputs into `u` (m, B), in the environments low to high - 1.

    Args:
        law: the fields of `EdgeLaw` as a plain tuple.
        edges: those of `EdgeArrays`.
        runs: those of `Runs`, of all agents.
        x: (n, B) states.
        estimate: (P, B) estimates.
        u: overwritten.
        terms: (E, d, B) scratch.
        velocity: (N * d, B) scratch.
        drift: (n, B) scratch.
        low: first environment.
        high: one past the last.
    """
    law, edges = EdgeLaw(*law), EdgeArrays(*edges)
    agents, dim = edges.position.shape
    wanted = velocity.reshape(agents, dim, velocity.shape[1])
    displacements(edges.kind, edges.own, edges.other, x, estimate, terms, low, high)
    sum_edges(1.0 if law.kind == SHRUNK_MEAN else law.gain, law.kind == TANH, edges.agent, terms, wanted, low, high)
    if law.kind in (LIMITED_MEAN, SHRUNK_MEAN):
        finish_mean(law, edges, x, wanted, low, high)
    if law.cancel_drift:
        subtract_drift(runs, x, drift, velocity, low, high)
    velocity_inputs(runs, x, velocity, u, low, high)
    if law.clip:
        for row in range(u.shape[0]):
            most = edges.limit[row]
            for e in range(high - low):
                value = u[row, place(low + e)]
                value = -most if value < -most else value
                u[row, place(low + e)] = most if value > most else value


@inlined
def finish_mean(law: Any, edges: Any, x: FloatArray, velocity: FloatArray, low: int, high: int) -> None:
    """From sums over edges to the velocities (N, d, B) of the laws that average."""
    for i in range(velocity.shape[0]):
        known, some = max(edges.known[i], 1), 1.0 if edges.edges[i] > 0 else 0.0
        share, number = law.second / known, float(edges.known[i])
        for e in range(high - low):
            at = place(low + e)
            if law.kind == SHRUNK_MEAN:
                for c in range(velocity.shape[1]):
                    own = x[edges.position[i, c], at]
                    velocity[i, c, at] = ((velocity[i, c, at] + number * own) * share - own) * (law.gain * some)
            else:
                square = 0.0
                for c in range(velocity.shape[1]):
                    velocity[i, c, at] /= known
                    square += velocity[i, c, at] * velocity[i, c, at]
                length = np.sqrt(square)
                factor = law.second / (length if length > law.second else law.second)
                for c in range(velocity.shape[1]):
                    velocity[i, c, at] *= factor


@inlined
def subtract_drift(runs: Any, x: FloatArray, drift: FloatArray, velocity: FloatArray, low: int, high: int) -> None:
    """Subtract the drift from the velocities of agents whose input is a velocity; the others come without one."""
    drifts(runs, x, drift, low, high)
    runs = Runs(*runs)
    v = 0
    for r in range(runs.kind.size):
        if runs.kind[r] <= DRIFTER:  # all of whose states are positions
            size = runs.agents[r] * runs.states[r]
            for component in range(size):
                for e in range(high - low):
                    velocity[v + component, place(low + e)] -= drift[runs.row[r] + component, place(low + e)]
            v += size
        else:
            v += 2 * runs.agents[r]  # carts, unicycles and vessels move in the plane


@compiled
def displacements(
    kind: IntArray,
    own: IntArray,
    other: IntArray,
    x: FloatArray,
    estimate: FloatArray,
    out: FloatArray,
    low: int,
    high: int,
) -> None:
    """Write (E, d, B) displacements along task edges: kind 0 reads the state, 1 an estimate, 2 writes nothing."""
    for edge in range(kind.size):
        if kind[edge] == 2:
            continue
        for c in range(own.shape[1]):
            own_row, other_row = own[edge, c], other[edge, c]
            if kind[edge] == 1:
                for e in range(high - low):
                    at = place(low + e)
                    out[edge, c, at] = estimate[other_row, at] - x[own_row, at]
            else:
                for e in range(high - low):
                    at = place(low + e)
                    out[edge, c, at] = x[other_row, at] - x[own_row, at]


@compiled
def sum_edges(
    gain: float, bounded: bool, agent: IntArray, displacement: FloatArray, out: FloatArray, low: int, high: int
) -> None:
    """Write gain * sum over edges of displacement (E, d, B), or of its tanh if `bounded`, into `out` (N, d, B).

    `agent` (E,) says to whom each edge belongs.
    """
    dim, width = displacement.shape[1], high - low
    for i in range(out.shape[0]):
        for c in range(dim):
            for e in range(width):
                out[i, c, place(low + e)] = 0.0
    if not bounded:
        for edge in range(agent.size):
            for c in range(dim):
                for e in range(width):
                    out[agent[edge], c, place(low + e)] += gain * displacement[edge, c, place(low + e)]
    elif displacement.shape[2] > 1:
        for edge in range(agent.size):
            for c in range(dim):
                for e in range(width):
                    out[agent[edge], c, place(low + e)] += gain * tanh(displacement[edge, c, place(low + e)])
    else:
        terms = np.empty(displacement.size)  # one environment: vectorise along the edges instead
        flat = displacement.reshape(-1)
        for q in range(flat.size):
            terms[q] = gain * tanh(flat[q])
        for edge in range(agent.size):
            for c in range(dim):
                out[agent[edge], c, 0] += terms[edge * dim + c]
