"""One agent's plant, simulated in its own process: the part that hardware takes the place of.

It moves by the simulator's own explicit Euler steps, or, where clocks differ and certificates are of the differential
equation, by Runge-Kutta steps of order 4 with the disturbance held over a step.
"""

from __future__ import annotations

import math

import numpy as np

from khop_env.observers import FloatArray, SolveError
from khop_env.physics import Disturbance, Fleet
from khop_env.physics.disturbance import Channels, Term

_DECIMALS = 12  # of grid times in s, as recordings have them


def grid_time(step: int, h: float) -> float:
    """Time in s of a step, without accumulated rounding."""
    return round(step * h, _DECIMALS)


class Robot:
    """A simulated robot.

    Args:
        fleet: all agents.
        agent: index of this one.
        h: step in s.
        disturbance: of the fleet, None for none. Only its terms that depend on time and on this agent act.
        drawn: (draws,) its random numbers.
        exact: Runge-Kutta steps in place of Euler's.

    Attributes:
        step: number of steps since time 0.
        x: (n_i,) state.
        u: (m_i,) input in force.
    """

    def __init__(
        self,
        fleet: Fleet,
        agent: int,
        h: float,
        x: FloatArray,
        disturbance: Disturbance | None,
        drawn: FloatArray,
        exact: bool = False,
    ) -> None:
        self.model, self.id, self.h = fleet.models[agent], fleet.ids[agent], h
        self.step, self.x, self.u = 0, np.array(x, np.float64), np.zeros(self.model.m)
        self._limit, self._exact = self.model.input_limit, exact
        self._disturbance = None if disturbance is None else OwnDisturbance(disturbance, fleet, agent, drawn)

    @property
    def t(self) -> float:
        """Time in s."""
        return grid_time(self.step, self.h)

    def hold(self, u: FloatArray) -> None:
        """Put inputs in force, kept within their limits."""
        self.u = np.clip(u, -self._limit, self._limit)

    def advance(self) -> None:
        """One step under the input in force.

        Raises:
            SolveError: if a state isn't finite any more.
        """
        t, x = self.t, self.x
        dt = grid_time(self.step + 1, self.h) - t
        w = np.zeros(self.model.n) if self._disturbance is None else self._disturbance(t, x)
        if self._exact:
            first = self._rate(t, x)
            second = self._rate(t + 0.5 * dt, x + 0.5 * dt * (first + w))
            third = self._rate(t + 0.5 * dt, x + 0.5 * dt * (second + w))
            fourth = self._rate(t + dt, x + dt * (third + w))
            self.x = x + dt * ((first + 2.0 * second + 2.0 * third + fourth) / 6.0 + w)
        else:
            self.x = x + dt * (self._rate(t, x) + w)
        self.step += 1
        if not all(map(math.isfinite, self.x.tolist())):
            raise SolveError(f"the state of {self.id!r} became {self.x.tolist()}; take a shorter --dt, or another law")

    def _rate(self, t: float, x: FloatArray) -> FloatArray:
        now, states = np.array([t]), x[None]
        return (self.model.drift(now, states) + self.model.input_map(now, states, self.u[None]))[0]


class OwnDisturbance:
    """The part of a fleet's disturbance that acts on one agent: a function of time and of its own state.

    Args:
        disturbance: of the fleet.
        fleet: all agents.
        agent: index of this one.
        drawn: (draws,) random numbers of the whole.
    """

    def __init__(self, disturbance: Disturbance, fleet: Fleet, agent: int, drawn: FloatArray) -> None:
        self._own, self._x = fleet.state_slice(agent), np.zeros((1, fleet.n))
        self._out = np.zeros((1, fleet.n))
        self._terms: list[tuple[Term, Channels, FloatArray]] = []
        first = 0
        for term in disturbance.terms:
            channels = term.channels(fleet)
            shape = term.draw(np.random.default_rng(0), channels).shape
            values = drawn[first : first + math.prod(shape)]
            first += math.prod(shape)
            if depends_on_others(term, fleet):
                continue
            own = (channels.index >= self._own.start) & (channels.index < self._own.stop)
            if len(shape) and shape[-1] == len(own):  # numbers per channel, as those of the library are: keep our own
                values = values.reshape(shape)[..., own].ravel()
                channels = Channels(channels.index[own], channels.amplitude[own], channels.positions)
            if own.any():
                self._terms.append((term, channels, values[None]))

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """(n_i,) w at the time `t` in s and the state `x` (n_i,)."""
        self._x[0, self._own] = x
        self._out[:] = 0.0
        for term, channels, drawn in self._terms:
            term.add(np.array([t]), self._x, drawn, channels, self._out)
        return self._out[0, self._own].copy()


def depends_on_others(term: Term, fleet: Fleet) -> bool:
    """Whether what a disturbance does to an agent depends on the states of others, which its process doesn't have."""
    channels, rng = term.channels(fleet), np.random.default_rng(0)
    drawn = term.draw(rng, channels).ravel()[None]
    base = rng.normal(size=(1, fleet.n))
    before = np.zeros((1, fleet.n))
    term.add(np.array([0.7]), base, drawn, channels, before)
    for agent in range(len(fleet)):
        other, after, own = base.copy(), np.zeros((1, fleet.n)), fleet.state_slice(agent)
        other[0, own] += 1.0
        term.add(np.array([0.7]), other, drawn, channels, after)
        after[0, own] = before[0, own]
        if not np.array_equal(before, after):
            return True
    return False
