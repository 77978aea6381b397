"""Statistics of the study: intervals over episodes and over training seeds, interquartile means, paired differences."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.outcomes import interval95
from benchmarks.study_measured import Row
from khop_env.observers import FloatArray

LEVEL = 3.0  # percent: policies within it are level; also the aim for estimates against the truth
DRAWS = 2000  # of the bootstrap


def iqm(values: FloatArray) -> float:
    """Interquartile mean: of what remains without the lowest and the highest quarter of all values.

    Source: R. Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021.

    Args:
        values: of any shape.
    """
    return float(_middle(np.sort(np.ravel(values))))


def iqm95(values: FloatArray) -> tuple[float, float]:
    """95 % interval of the interquartile mean: percentiles of a bootstrap that draws both seeds and episodes again.

    Args:
        values: (seeds, episodes).
    """
    rng, (seeds, episodes) = np.random.default_rng(0), values.shape
    rows = rng.integers(seeds, size=(DRAWS, seeds, 1))
    drawn = values[rows, rng.integers(episodes, size=(DRAWS, 1, episodes))]
    low, high = np.quantile(_middle(np.sort(drawn.reshape(DRAWS, -1), axis=1)), (0.025, 0.975))
    return float(low), float(high)


def short(value: float, digits: int = 2) -> str:
    """A number with so many digits, or all those before the point."""
    return f"{value:.0f}" if abs(value) >= 10.0 ** (digits - 1) else f"{value:.{digits}g}"


def _middle(ordered: FloatArray) -> FloatArray:
    cut = ordered.shape[-1] // 4
    mean: FloatArray = ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)
    return mean


@dataclass(frozen=True)
class Difference:
    """How much larger a measurement of one row is than another's, paired by episode and by training seed.

    Attributes:
        mean: of the differences.
        over_episodes: half width of the 95 % interval over episodes, after averaging over seeds.
        over_seeds: the same over training seeds; None for a single one, 0 for scripts.
        reference: mean of the other row.
    """

    mean: float
    over_episodes: float
    over_seeds: float | None
    reference: float

    @property
    def clear(self) -> bool:
        """Whether both intervals exclude 0."""
        return self.over_seeds is not None and abs(self.mean) > max(self.over_episodes, self.over_seeds)

    @property
    def percent(self) -> float:
        """The mean in percent of the reference."""
        return self._in_percent(self.mean)

    @property
    def half(self) -> float:
        """The wider interval's half width in percent of the reference; infinite with a single seed."""
        return math.inf if self.over_seeds is None else self._in_percent(max(self.over_episodes, self.over_seeds))

    @property
    def relative(self) -> str:
        """The mean in percent of the reference, in words."""
        return f"{'+' if self.percent >= 0.0 else ''}{short(self.percent)} %"

    @property
    def word(self) -> str:
        """Better or worse where both intervals exclude 0; level where they don't, but stay within 3 %."""
        if self.over_seeds is None:
            return "one seed only"
        if self.clear:
            return "better" if self.mean > 0.0 else "worse"
        return "level" if abs(self.percent) + self.half < LEVEL else "no clear difference"

    def __str__(self) -> str:
        over_seeds = f", ± {short(self.over_seeds)} over training seeds" if self.over_seeds else ""
        intervals = f"± {short(self.over_episodes)} over episodes{over_seeds}"
        return f"{'+' if self.mean >= 0.0 else ''}{short(self.mean, 3)} {intervals} ({self.relative}): {self.word}"

    def _in_percent(self, value: float) -> float:
        return 100.0 * value / abs(self.reference) if self.reference else math.nan


def difference(ours: Row, theirs: Row, key: str = "returns") -> Difference | None:
    """By how much a measurement of ours is larger; None if two learned rows have no seed in common.

    Args:
        ours: a learned row, or a script's.
        theirs: likewise; of two learned rows the seeds in both are compared.
        key: name of the measurement.
    """
    seeds = [seed for seed in ours.seeds if not theirs.learned or seed in theirs.seeds]
    if not seeds:
        return None
    other = theirs.values(key, seeds)
    more = ours.values(key, seeds) - other
    over_episodes = interval95(more.mean(axis=0))
    return Difference(
        float(more.mean()),
        math.inf if over_episodes is None else over_episodes,
        interval95(more.mean(axis=1)) if ours.learned else 0.0,
        float(other.mean()),
    )
