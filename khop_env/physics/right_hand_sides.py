"""Compiled right-hand sides of the library's models, over the rows of many agents and a range of environments.

Arrays are (rows, B), batch last. A run is a number of consecutive agents, or of estimates of agents, with equal models;
the models' equations and their sources are in `khop_env.physics.models`. Entry (row, b) of every result depends on
column b of the arguments only, and its bits on nothing else, however the batch is divided.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from khop_env.compiled import compiled, inlined, place
from khop_env.elementary import cos, sin, tanh

if TYPE_CHECKING:
    from khop_env.physics.agent_model import AgentModel, FloatArray, IndexArray

INTEGRATOR, DRIFTER, CART, UNICYCLE, VESSEL = range(5)
VELOCITY_RATE = 2.0  # 1/s: decay rate of the velocity error where the input is a force or an acceleration
OFFSET = 0.3  # m ahead of a unicycle's axle: the point whose velocity is commanded


class Form(NamedTuple):
    """The compiled form of a model: which right-hand side, and its numbers.

    Attributes:
        kind: INTEGRATOR, DRIFTER, ...
        parameters: of the model, in the order in which the loops below read them.
    """

    kind: int
    parameters: tuple[float, ...] = ()


class Runs(NamedTuple):
    """Runs of agents with equal models of the library.

    Attributes:
        kind: (R,) of the model.
        agents: (R,) number of agents.
        states: (R,) states of each agent, n_i.
        inputs: (R,) inputs of each, m_i.
        row: (R,) where their states begin among the rows.
        input_row: (R,) where their inputs begin.
        first: (R,) where the model's numbers begin among `parameters`.
        parameters: of all models.
    """

    kind: IndexArray
    agents: IndexArray
    states: IndexArray
    inputs: IndexArray
    row: IndexArray
    input_row: IndexArray
    first: IndexArray
    parameters: FloatArray

    @classmethod
    def of(cls, parts: Sequence[tuple[AgentModel, int, int, int]]) -> Runs:
        """Runs of (model, agents, first row, first row of inputs); the models have a compiled form."""
        forms = [_with_form(model) for model, *_ in parts]
        sizes = [(agents, model.n, model.m, row, input_row) for model, agents, row, input_row in parts]
        return _runs([(form, *each) for form, each in zip(forms, sizes, strict=True)])


@compiled
def drifts(runs: Any, x: FloatArray, out: FloatArray, low: int, high: int) -> None:
    """Write the drift of every run at the states `x` into its rows of `out`, in the environments low to high - 1.

    `runs` are the fields of `Runs` as a plain tuple, here and below.
    """
    runs = Runs(*runs)
    p = runs.parameters
    for r in range(runs.kind.size):
        kind, agents, row, q = runs.kind[r], runs.agents[r], runs.row[r], runs.first[r]
        if kind == DRIFTER:
            drifter_drift(agents, row, x, out, low, high)
        elif kind == CART:
            cart_drift(agents, row, p[q], x, out, low, high)
        elif kind == VESSEL:
            vessel_drift(agents, row, p[q : q + 9], x, out, low, high)
        else:
            for component in range(agents * runs.states[r]):
                for e in range(high - low):
                    out[row + component, place(low + e)] = 0.0


@compiled
def input_maps(runs: Any, x: FloatArray, u: FloatArray, out: FloatArray, low: int, high: int) -> None:
    """Write the input map of every run at the states `x` and inputs `u` into its rows of `out`, likewise."""
    runs = Runs(*runs)
    p = runs.parameters
    for r in range(runs.kind.size):
        kind, agents, row, of_u, q = runs.kind[r], runs.agents[r], runs.row[r], runs.input_row[r], runs.first[r]
        if kind == UNICYCLE:
            unicycle_input_map(agents, row, of_u, x, u, out, low, high)
        elif kind in (INTEGRATOR, DRIFTER):
            for component in range(agents * runs.states[r]):
                for e in range(high - low):
                    out[row + component, place(low + e)] = u[of_u + component, place(low + e)]
        else:
            half = runs.inputs[r]  # positions first, then as many velocities, which the inputs accelerate
            for i in range(agents):
                for c in range(half):
                    mass = p[q + c] if kind == VESSEL else 1.0
                    at = row + 2 * half * i + c
                    for e in range(high - low):
                        out[at, place(low + e)] = 0.0
                        out[at + half, place(low + e)] = u[of_u + half * i + c, place(low + e)] / mass


@compiled
def velocity_inputs(runs: Any, x: FloatArray, velocity: FloatArray, out: FloatArray, low: int, high: int) -> None:
    """Write inputs that make positions follow `velocity` (agents * d, B), not clipped, into `out` (m, B).

    The agents of all runs lie in the order of the runs in `velocity`.
    """
    runs = Runs(*runs)
    p = runs.parameters
    v = 0
    for r in range(runs.kind.size):
        kind, agents, row, of_u, q = runs.kind[r], runs.agents[r], runs.row[r], runs.input_row[r], runs.first[r]
        if kind == CART:
            for i in range(agents):
                for c in range(2):
                    for e in range(high - low):
                        at = place(low + e)
                        speed = x[row + 4 * i + 2 + c, at]
                        error = velocity[v + 2 * i + c, at] - speed
                        out[of_u + 2 * i + c, at] = p[q] * speed + VELOCITY_RATE * error
            v += 2 * agents
        elif kind == UNICYCLE:
            for i in range(agents):
                for e in range(high - low):
                    at = place(low + e)
                    heading = x[row + 3 * i + 2, at]
                    along, across = cos(heading), sin(heading)
                    vx, vy = velocity[v + 2 * i, at], velocity[v + 2 * i + 1, at]
                    out[of_u + 2 * i, at] = along * vx + across * vy
                    out[of_u + 2 * i + 1, at] = (along * vy - across * vx) / OFFSET
            v += 2 * agents
        elif kind == VESSEL:
            for i in range(agents):
                for e in range(high - low):
                    at = place(low + e)
                    heading = x[row + 6 * i + 2, at]
                    along, across = cos(heading), sin(heading)
                    vx, vy = velocity[v + 2 * i, at], velocity[v + 2 * i + 1, at]
                    surge = along * vx + across * vy - x[row + 6 * i + 3, at]
                    sway = along * vy - across * vx - x[row + 6 * i + 4, at]
                    out[of_u + 3 * i, at] = p[q] * VELOCITY_RATE * surge
                    out[of_u + 3 * i + 1, at] = p[q + 1] * VELOCITY_RATE * sway
                    out[of_u + 3 * i + 2, at] = p[q + 2] * VELOCITY_RATE * (0.0 - x[row + 6 * i + 5, at])
            v += 2 * agents
        else:
            size = agents * runs.inputs[r]
            for component in range(size):
                for e in range(high - low):
                    out[of_u + component, place(low + e)] = velocity[v + component, place(low + e)]
            v += size


@inlined
def drifter_drift(agents: int, row: int, x: FloatArray, out: FloatArray, low: int, high: int) -> None:
    """`DriftingIntegrator.drift`; the loop runs along whichever axis is longer, so that it vectorises."""
    width = high - low
    if width >= agents:
        for i in range(agents):
            r = row + 2 * i
            for e in range(width):
                at = place(low + e)
                out[r, at] = tanh(0.5 * (x[r, at] + x[r + 1, at]))
            for e in range(width):
                at = place(low + e)
                out[r + 1, at] = sin(0.5 * (x[r, at] - x[r + 1, at]))
    else:
        for e in range(low, high):
            for i in range(agents):
                r = place(row + 2 * i)
                out[r, e] = tanh(0.5 * (x[r, e] + x[place(row + 2 * i + 1), e]))
            for i in range(agents):
                r = place(row + 2 * i + 1)
                out[r, e] = sin(0.5 * (x[place(row + 2 * i), e] - x[r, e]))


@inlined
def cart_drift(agents: int, row: int, damping: float, x: FloatArray, out: FloatArray, low: int, high: int) -> None:
    """`DoubleIntegrator.drift`."""
    for i in range(agents):
        for c in range(2):
            r = row + 4 * i + c
            for e in range(high - low):
                at = place(low + e)
                out[r, at] = x[r + 2, at]
                out[r + 2, at] = -damping * x[r + 2, at]


@inlined
def vessel_drift(agents: int, row: int, p: FloatArray, x: FloatArray, out: FloatArray, low: int, high: int) -> None:
    """`SurfaceVessel.drift`; p has mass, linear and quadratic drag, three numbers each."""
    m1, m2, m3 = p[0], p[1], p[2]
    for i in range(agents):
        r = row + 6 * i
        for e in range(high - low):
            at = place(low + e)
            along, across = cos(x[r + 2, at]), sin(x[r + 2, at])
            surge, sway, yaw = x[r + 3, at], x[r + 4, at], x[r + 5, at]
            out[r, at] = along * surge - across * sway
            out[r + 1, at] = across * surge + along * sway
            out[r + 2, at] = yaw
            out[r + 3, at] = (m2 * sway * yaw - (p[3] + p[6] * abs(surge)) * surge) / m1
            out[r + 4, at] = (-m1 * surge * yaw - (p[4] + p[7] * abs(sway)) * sway) / m2
            out[r + 5, at] = ((m1 - m2) * surge * sway - (p[5] + p[8] * abs(yaw)) * yaw) / m3


@inlined
def unicycle_input_map(
    agents: int, row: int, of_u: int, x: FloatArray, u: FloatArray, out: FloatArray, low: int, high: int
) -> None:
    """`Unicycle.input_map`."""
    for i in range(agents):
        r, s = row + 3 * i, of_u + 2 * i
        for e in range(high - low):
            at = place(low + e)
            out[r, at] = u[s, at] * cos(x[r + 2, at])
            out[r + 1, at] = u[s, at] * sin(x[r + 2, at])
            out[r + 2, at] = u[s + 1, at]


def evaluated(kernel: Callable[..., None], form: Form, width: int, *arguments: FloatArray) -> FloatArray:
    """A loop above for agents of one model, on arrays as models get them.

    Args:
        kernel: `drifts`, `input_maps` or `velocity_inputs`.
        form: of the model.
        width: number of values of each agent in the result.
        arguments: states (..., n), and inputs or velocities. Leading axes broadcast; (B, agents) in a simulator.

    Returns:
        (..., width).
    """
    shape = np.broadcast_shapes(*(values.shape[:-1] for values in arguments))
    batch, agents = shape if len(shape) == 2 else (1, math.prod(shape))
    rows = []
    for values in arguments:
        size = values.shape[-1]
        values = np.broadcast_to(values, (*shape, size)).reshape(batch, agents, size)
        rows.append(np.ascontiguousarray(values.transpose(1, 2, 0).reshape(agents * size, batch), np.float64))
    out = np.empty((agents * width, batch))
    kernel(_one_run(form, arguments[0].shape[-1], arguments[-1].shape[-1], agents), *rows, out, 0, batch)
    return out.reshape(agents, width, batch).transpose(2, 0, 1).reshape(*shape, width)


def _with_form(model: AgentModel) -> Form:
    assert model.form is not None
    return model.form


@functools.lru_cache(maxsize=256)
def _one_run(form: Form, states: int, inputs: int, agents: int) -> tuple[Any, ...]:
    return tuple(_runs([(form, agents, states, inputs, 0, 0)]))


def _runs(parts: Sequence[tuple[Form, int, int, int, int, int]]) -> Runs:
    rows, parameters = [], list[float]()
    for form, *sizes in parts:
        rows.append((form.kind, *sizes, len(parameters)))
        parameters += form.parameters
    table = np.array(rows, np.int64).reshape(-1, 7)
    kind, agents, states, inputs, row, input_row, first = (np.ascontiguousarray(column) for column in table.T)
    return Runs(kind, agents, states, inputs, row, input_row, first, np.array(parameters, np.float64))
