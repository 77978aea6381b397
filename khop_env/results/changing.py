"""Assumption 3 on a graph that changes: what holds of a scenario's schedule of links, and for whom it doesn't."""

from __future__ import annotations

import numpy as np

from khop_env.network import Both, Fixed, Outage, Range, Schedule, Switching
from khop_env.observers.weights import WeightsNow
from khop_env.scenarios import Scenario
from khop_env.scenarios.scenario import number_of_steps

_TIMES, _EPISODES, _LISTED = 1000, 100, 6
_WORK = 2e9  # about; of the elimination, which is cubic in the number of observers


def changing_graph(scenario: Scenario) -> str:
    """Reason for "doesn't hold" of Assumption 3 where the scenario has a schedule; names pairs that are cut off."""
    assert scenario.schedule is not None
    fleet, design = scenario.fleet, scenario.design
    parts = scenario.schedule.parts
    kinds = list(dict.fromkeys(type(part).__name__ for part in parts))
    changes = "a part of the links that doesn't change" if kinds == ["Fixed"] else "links come and go"
    found = [
        f"{changes} ({', '.join(kinds)}). By theorem bounds hold between changes, from where the funnels have "
        "been widened to hold the jump; by construction at the grid points of the proximal step, for the links that "
        "are up then (docs/theory/graphs.md)"
    ]
    known = tuple(part for part in parts if not isinstance(part, Range))
    if len(known) < len(parts):
        found.append("who is in range depends on the run, so what follows is without Range, and in a run more is down")
    drawn = not all(map(_is_determined, known))
    steps = number_of_steps(scenario.duration, scenario.dt)
    times = np.unique(np.linspace(0, steps, 1 + min(steps, _TIMES // _EPISODES if drawn else _TIMES)).round())
    largest, cut_off, when = _followed(scenario, Both(known or (Fixed(),)), times * scenario.dt, drawn)
    layout = design.states.layout
    where = f"{_EPISODES} drawn episodes" if drawn else "the run"
    pairs = np.flatnonzero(cut_off > 0.0)
    if pairs.size:
        target = np.repeat(layout.target, layout.arrays.observers)
        listed = [
            f"{fleet.ids[layout.observer[q]]!r} from {fleet.ids[target[q]]!r} (at {when[q]:.3g} s)"
            for q in pairs[np.lexsort((when[pairs], -cut_off[pairs]))][:_LISTED]
        ]
        more = f" and {pairs.size - _LISTED} more" if pairs.size > _LISTED else ""
        found.append(
            f"in {where} {pairs.size} of {layout.pairs} pairs are cut off at times, {100.0 * cut_off.mean():.3g} % of "
            f"all pairs and times; their estimates are predictions without a bound then: {', '.join(listed)}{more}"
        )
    else:
        found.append(f"in {where} each target reaches all its observers all the time")
    if largest > 1.0 + 1e-9:
        found.append(
            f"delta is designed for all links: with fewer an observer's own bound is up to {largest:.3g} times delta"
        )
    return "; ".join(found)


def _is_determined(part: Schedule) -> bool:
    if isinstance(part, Outage):
        fixed = not isinstance(part.start, tuple) and not isinstance(part.duration, tuple)
        return fixed and (part.agent is not None or part.link is not None)
    return isinstance(part, Fixed | Switching)


def _followed(
    scenario: Scenario, schedule: Schedule, times: np.ndarray, drawn: bool
) -> tuple[float, np.ndarray, np.ndarray]:
    """Largest own bound over delta, each pair's share of times without one, and its first such time in s."""
    design, layout = scenario.design, scenario.design.states.layout
    rng = np.random.default_rng(0)
    keys = rng.integers(0, 2**64, _EPISODES if drawn else 1, np.uint64)
    key, t = np.repeat(keys, len(times)), np.tile(times, len(keys))
    x = np.repeat(scenario.initial.center[:, None], t.size, axis=1)
    up = schedule.bind(design.links, scenario.fleet.position_index).up(
        key, t, x, np.empty((len(design.links), t.size), bool)
    )
    patterns, of_sample = np.unique(up, axis=1, return_inverse=True)
    gain = design.states.gain[layout.arrays.row[np.repeat(np.arange(len(layout.target)), layout.arrays.observers)]]
    largest, without = 0.0, np.zeros((layout.pairs, patterns.shape[1]), bool)
    chunk = max(1, 2**22 // max(1, len(layout.entry_link)))
    affordable = max(1, int(_WORK / (1.0 + np.sum(layout.arrays.observers.astype(float) ** 3))))
    for first in range(0, patterns.shape[1], chunk):
        some = np.ascontiguousarray(patterns[:, first : first + chunk])
        now = WeightsNow(layout, some.shape[1])
        without[:, first : first + chunk] = now.of(some)[0] == 0.0
        if first < affordable:
            some = np.ascontiguousarray(some[:, : affordable - first])
            own = WeightsNow(layout, some.shape[1]).inverse_row_sums(some) * gain[:, None]
            largest = max(largest, float(own[np.isfinite(own)].max(initial=0.0)))
    cut = without[:, of_sample.ravel()]
    earliest = np.where(cut, t, np.inf).min(axis=1, initial=np.inf)
    return largest, cut.mean(axis=1), earliest
