"""The library's disturbances: sines, noise in a band, gusts, and a coupling to the whole fleet.

Every declared bound is the least upper bound of |w| over time, states and draws (to rounding).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from khop_env.physics.agent_model import FloatArray
from khop_env.physics.disturbance import Channels, Term, freeze_list
from khop_env.physics.fleet import Fleet
from khop_env.physics.waveforms import COUPLING, GUSTS, SINES, Form, add_coupling, add_gusts, add_sines

_MOST_DRAWN = 10_000  # sines or pulses of one channel
_SHORTEST_PULSE = 1e-6  # s
_HIGHEST_FREQUENCY = 1e6  # rad/s: above it the angle of a long run is rounded


@dataclass(frozen=True)
class BandLimitedNoise(Term):
    """Noise with its power in a band: per channel a sum of `components` sines of equal size that add up to `amplitude`.

        w = amplitude / J  sum_j sin(omega_j t + phi_j)

    omega_j is drawn from the j-th of J equal parts of the band and phi_j from a circle. The bound is attained only when
    all crests meet; the standard deviation is amplitude / sqrt(2 J). Smooth in t, with |w'| <= amplitude * band[1].

    Source: S. O. Rice, Mathematical Analysis of Random Noise, Bell System Technical Journal 23, 1944, section 2.8.

    Attributes:
        band: Lowest and highest angular frequency in rad/s.
        components: Number of sines J.
    """

    band: tuple[float, float] = (0.5, 10.0)
    components: int = 8

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_range(self, "band")
        _check_count(self, "components")

    def draw(self, rng: np.random.Generator, channels: Channels) -> FloatArray:
        """Angular frequencies and phases, shape (2, components, C)."""
        return _draw_sines(rng, self.band, self.components, channels)

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its waveform, compiled."""
        return Form(SINES, int(self.components))

    def add(self, t: FloatArray, x: FloatArray, drawn: FloatArray, channels: Channels, out: FloatArray) -> None:
        """Add the sines."""
        add_sines(t, drawn, 0, self.components, channels.index, channels.amplitude, out.T, 0, len(t))


@dataclass(frozen=True)
class Sinusoid(Term):
    """One sine per channel, amplitude * sin(omega t + phi), with omega and phi drawn per episode.

    Attributes:
        frequency: Lowest and highest angular frequency omega in rad/s.
    """

    frequency: tuple[float, float] = (0.5, 2.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_range(self, "frequency")

    def draw(self, rng: np.random.Generator, channels: Channels) -> FloatArray:
        """Angular frequencies and phases, shape (2, 1, C)."""
        return _draw_sines(rng, self.frequency, 1, channels)

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its waveform, compiled."""
        return Form(SINES, 1)

    def add(self, t: FloatArray, x: FloatArray, drawn: FloatArray, channels: Channels, out: FloatArray) -> None:
        """Add the sine."""
        add_sines(t, drawn, 0, 1, channels.index, channels.amplitude, out.T, 0, len(t))


@dataclass(frozen=True)
class Gust(Term):
    """Smooth pulses of random sign at random times: in each period one "1 - cosine" gust per channel.

        w = +-amplitude (1 - cos(2 pi s / duration)) / 2,    0 <= s <= duration, s seconds after its beginning

    Continuously differentiable in t, with |w'| <= pi amplitude / duration. The times and signs repeat after `pulses`
    periods, so that an episode of any length holds finitely many numbers.

    Source: the discrete gust of airworthiness rules, e.g. 14 CFR 25.341(a) and MIL-F-8785C, section 3.7.

    Attributes:
        duration: Length of a pulse in seconds.
        period: A pulse begins and ends within each such window, in seconds; at least `duration`.
        pulses: Number of windows before the sequence repeats.
    """

    duration: float = 1.0
    period: float = 4.0
    pulses: int = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _SHORTEST_PULSE <= self.duration <= self.period < math.inf:
            raise ValueError(
                f"Gust needs {_SHORTEST_PULSE:g} <= duration <= period, in s; got duration {self.duration}, period "
                f"{self.period}"
            )
        _check_count(self, "pulses")

    def draw(self, rng: np.random.Generator, channels: Channels) -> FloatArray:
        """Beginnings within the window in seconds, and signs, shape (2, pulses, C)."""
        shape = (self.pulses, channels.index.size)
        return np.stack([rng.uniform(0.0, self.period - self.duration, shape), rng.choice((-1.0, 1.0), shape)])

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its waveform, compiled."""
        return Form(GUSTS, int(self.pulses), float(self.duration), float(self.period))

    def add(self, t: FloatArray, x: FloatArray, drawn: FloatArray, channels: Channels, out: FloatArray) -> None:
        """Add the pulse of each environment's current window."""
        window = (self.duration, self.period, self.pulses)
        add_gusts(t, drawn, 0, *window, channels.index, channels.amplitude, out.T, 0, len(t))


@dataclass(frozen=True)
class Coupling(Term):
    """A bounded pull of each agent towards the mean of all: a w_i that depends on the state of the whole fleet.

        w_i = amplitude * tanh(gain * (mean position of all agents - position of i)),    on the position components

    `amplitude` is a number, or one for each of the d axes; the other states aren't disturbed.

    Attributes:
        gain: In 1/m; negative for a push away from the mean.
    """

    gain: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not math.isfinite(self.gain):
            raise ValueError(f"Coupling.gain must be finite; got {self.gain!r}")

    def channels(self, fleet: Fleet) -> Channels:
        """The position components of its agents."""
        return self.channels_of(fleet, list(fleet.position_index), "position axes")

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its waveform, compiled."""
        return Form(COUPLING, first=float(self.gain))

    def add(self, t: FloatArray, x: FloatArray, drawn: FloatArray, channels: Channels, out: FloatArray) -> None:
        """Add the pull."""
        add_coupling(x.T, self.gain, channels.positions, channels.index, channels.amplitude, out.T, 0, len(t))


DISTURBANCES: dict[str, type[Term]] = {
    "sinusoid": Sinusoid,
    "noise": BandLimitedNoise,
    "gust": Gust,
    "coupling": Coupling,
}
"""Disturbances by name, as scenario files have it."""


def _check_range(term: Term, name: str) -> None:
    freeze_list(term, name)
    value = getattr(term, name)
    if not (isinstance(value, tuple) and len(value) == 2 and 0 < value[0] <= value[1] <= _HIGHEST_FREQUENCY):
        raise ValueError(
            f"{term.__class__.__name__}.{name} must be (lowest, highest) in rad/s with 0 < lowest <= highest, at most "
            f"{_HIGHEST_FREQUENCY:g}; got {value!r}"
        )


def _check_count(term: Term, name: str) -> None:
    value = getattr(term, name)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 1 <= value <= _MOST_DRAWN:
        raise ValueError(
            f"{term.__class__.__name__}.{name} must be an integer from 1 to {_MOST_DRAWN}, as all are drawn "
            f"beforehand; got {value!r}"
        )


def _draw_sines(rng: np.random.Generator, band: tuple[float, float], count: int, channels: Channels) -> FloatArray:
    """Angular frequencies, the j-th from the j-th of `count` equal parts of the band, and phases: (2, count, C)."""
    size = (count, channels.index.size)
    part = (np.arange(count)[:, None] + rng.uniform(size=size)) / count
    return np.stack([band[0] + (band[1] - band[0]) * part, rng.uniform(0.0, 2.0 * np.pi, size)])
