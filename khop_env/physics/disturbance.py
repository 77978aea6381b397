"""Bounded disturbances w_i(x, t): continuous and uniformly bounded, as the paper's Assumption 1-iii asks.

A disturbance is a frozen description, added to others with `+`, and attached to a fleet when a simulator is built.
All its randomness is a vector of numbers drawn once per episode; given that vector, w is a pure function of t and x.

    disturbance = Sinusoid(0.3, frequency=(0.5, 2.0)) + Gust(0.5, agents="vessel")
    attached = disturbance.attach(fleet)
    drawn[b] = attached.draw(rng)           # at reset, row b of (B, attached.draws)
    w = attached(t, x, drawn, out)          # any number of times
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import numpy as np

from khop_env.physics.agent_model import FloatArray, IndexArray, did_you_mean
from khop_env.physics.fleet import Fleet
from khop_env.physics.waveforms import Form, TermArrays, disturb

Amplitude: TypeAlias = float | tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Channels:
    """The components on which one disturbance acts.

    Attributes:
        index: Components of the flat state, shape (C,).
        amplitude: Bound on |w| of each, in state units per second, shape (C,).
        positions: Components of the flat state that hold the agents' positions, shape (N, d).
    """

    index: IndexArray
    amplitude: FloatArray
    positions: IndexArray


class Disturbance:
    """Base class of disturbances, which can be added and attached: a single `Term`, or a `Sum`."""

    @property
    def terms(self) -> tuple[Term, ...]:
        """The single disturbances that it is the sum of."""
        raise NotImplementedError

    def __add__(self, other: Disturbance) -> Sum:
        if not isinstance(other, Disturbance):
            return NotImplemented
        return Sum(self.terms + other.terms)

    def attach(self, fleet: Fleet) -> AttachedDisturbance:
        """Find the components of a fleet's state that it acts on.

        Raises:
            ValueError: The fleet has no such agents, or an amplitude's length doesn't match them.
        """
        return AttachedDisturbance(self.terms, fleet)


@dataclass(frozen=True)
class Sum(Disturbance):
    """Several disturbances at once; `Sum()` is none at all."""

    terms: tuple[Term, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", tuple(single for term in self.terms for single in term.terms))


@dataclass(frozen=True)
class Term(Disturbance):
    """A single disturbance. A new kind subclasses it and writes `add`, and `draw` if it needs random numbers.

    Attributes:
        amplitude: Bound on |w| in state units per second: one number for every state, or one for each of
            an agent's states.
        agents: The agents it acts on: None for all, a type ("vessel"), an id ("vessel_0"), or a tuple of these.
        form: Its compiled form, for the library's own; None for those whose `add` is Python.
    """

    amplitude: Amplitude
    agents: str | tuple[str, ...] | None = field(default=None, kw_only=True)
    form: ClassVar[Form | None] = None

    def __init_subclass__(cls) -> None:
        if "form" not in vars(cls):
            cls.form = None  # a subclass may have another `add` than the class whose compiled form it would inherit

    def __post_init__(self) -> None:
        for name in ("amplitude", "agents"):
            freeze_list(self, name)
        values = np.asarray(self.amplitude, dtype=np.float64)
        if values.ndim > 1 or not (np.isfinite(values) & (values >= 0)).all():
            raise ValueError(
                f"{self._name}.amplitude must be a number or a tuple of numbers, finite and non-negative; "
                f"got {self.amplitude!r}"
            )

    @property
    def terms(self) -> tuple[Term, ...]:
        """Only this one."""
        return (self,)

    def channels(self, fleet: Fleet) -> Channels:
        """The state components of `fleet` that it acts on: by default those whose amplitude isn't zero."""
        states = [np.arange(*fleet.state_offset[i : i + 2]) for i in range(len(fleet))]
        channels = self.channels_of(fleet, states, "states")
        used = channels.amplitude > 0
        return Channels(channels.index[used], channels.amplitude[used], channels.positions)

    def draw(self, rng: np.random.Generator, channels: Channels) -> FloatArray:
        """The random numbers of one episode; their count depends on the parameters and channels only."""
        return np.empty(0)

    def add(self, t: FloatArray, x: FloatArray, drawn: FloatArray, channels: Channels, out: FloatArray) -> None:
        """Add w to `out` (B, n) at times t (B,), states x (B, n) and each environment's draws, flat (B, draws)."""
        raise NotImplementedError(f"{self._name} has no add(t, x, drawn, channels, out)")

    def channels_of(self, fleet: Fleet, components: Sequence[IndexArray], what: str) -> Channels:
        """Pair the amplitude with state components of each agent; `what` names them in error messages."""
        chosen = self._chosen_agents(fleet)
        if isinstance(self.amplitude, tuple):
            wrong = [
                f"{fleet.ids[i]} ({len(components[i])})" for i in chosen if len(components[i]) != len(self.amplitude)
            ]
            if wrong:
                raise ValueError(
                    f"{self._name}.amplitude has {len(self.amplitude)} entries, expected one for each of the agent's "
                    f"{what}: {', '.join(wrong[:8])}{' and others' if len(wrong) > 8 else ''}"
                )
        index = np.concatenate([components[i] for i in chosen])
        amplitude = np.concatenate([np.broadcast_to(self.amplitude, len(components[i])) for i in chosen])
        return Channels(index, amplitude.astype(np.float64), fleet.position_index)

    def _chosen_agents(self, fleet: Fleet) -> list[int]:
        if self.agents is None:
            return list(range(len(fleet)))
        named: dict[str, list[int]] = {}
        for i, model in enumerate(fleet.models):
            named.setdefault(model.type, []).append(i)
            named[fleet.ids[i]] = [i]
        chosen: set[int] = set()
        for name in (self.agents,) if isinstance(self.agents, str) else self.agents:
            if name not in named:
                raise ValueError(f"{self._name}.agents: no agent or type {name!r}; {did_you_mean(name, named)}")
            chosen.update(named[name])
        if not chosen:
            raise ValueError(f"{self._name}.agents is empty; None means all agents")
        return sorted(chosen)

    @property
    def _name(self) -> str:
        return self.__class__.__name__


class AttachedDisturbance:
    """Disturbances bound to a fleet: their sum, a pure function of (t, x, drawn).

    Attributes:
        bound: Bound on each component of |w| in state units per second, shape (n,).
        draws: Number K of random numbers that an episode holds.
        arrays: The fields of `TermArrays` as a plain tuple, where all terms have a compiled form; None otherwise.
    """

    def __init__(self, terms: Sequence[Term], fleet: Fleet) -> None:
        self.bound: FloatArray = np.zeros(fleet.n)
        self.draws = 0
        self._parts: list[tuple[Term, Channels, slice]] = []
        for term in terms:
            channels = term.channels(fleet)
            np.add.at(self.bound, channels.index, channels.amplitude)
            count = term.draw(np.random.default_rng(0), channels).size  # a dry run that counts its random numbers
            self._parts.append((term, channels, slice(self.draws, self.draws + count)))
            self.draws += count
        self.arrays: tuple[Any, ...] | None = _arrays(self._parts, fleet)

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Random numbers for one episode, shape (K,)."""
        return np.concatenate([np.empty(0), *(term.draw(rng, channels).ravel() for term, channels, _ in self._parts)])

    def __call__(self, t: FloatArray, x: FloatArray, drawn: FloatArray, out: FloatArray) -> FloatArray:
        """Fill `out` with w.

        Args:
            t: Time of each environment in seconds, t >= 0, shape (B,).
            x: Fleet states, shape (B, n).
            drawn: Each environment's draws, shape (B, K).
            out: Overwritten with w in state units per second, shape (B, n).

        Returns:
            `out`.
        """
        if self.arrays is not None:
            disturb(self.arrays, t, x.T, drawn, out.T, 0, len(t))
            return out
        out.fill(0.0)
        for term, channels, part in self._parts:
            term.add(t, x, drawn[:, part], channels, out)
        return out


def _arrays(parts: Sequence[tuple[Term, Channels, slice]], fleet: Fleet) -> tuple[Any, ...] | None:
    forms = [form for form in (term.form for term, _, _ in parts) if form is not None]
    if len(forms) < len(parts):
        return None
    kind, count, first, second = zip(*forms, strict=True) if forms else ((), (), (), ())
    sizes = [channels.index.size for _, channels, _ in parts]
    return tuple(
        TermArrays(
            np.array(kind, np.int64),
            np.array(count, np.int64),
            np.array(first, np.float64),
            np.array(second, np.float64),
            np.array([part.start for _, _, part in parts], np.int64),
            np.cumsum([0, *sizes]),
            np.concatenate([np.zeros(0, np.int64), *(channels.index for _, channels, _ in parts)]),
            np.concatenate([np.zeros(0), *(channels.amplitude for _, channels, _ in parts)]),
            np.ascontiguousarray(fleet.position_index),
        )
    )


def freeze_list(term: Term, name: str) -> None:
    """Turn a list or array, as a scenario file has it, into a tuple, which a frozen dataclass can hash."""
    value = getattr(term, name)
    if isinstance(value, list | np.ndarray):
        object.__setattr__(term, name, tuple(np.asarray(value).tolist()))
