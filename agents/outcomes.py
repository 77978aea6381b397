"""Outcomes of episodes in which agents may collide: from the infos "cost", "arrived" and "min_distance"."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policy import Policy
from khop_env.env import BatchedEnv
from khop_env.observers import FloatArray

STILL = 0.1  # m: agents that move less in `STILL_TIME` don't move
STILL_TIME = 2.0  # s
Z95 = 1.959963984540054  # quantile of the normal distribution


class Outcomes:
    """Measures B episodes, step by step.

    Args:
        env: reset.
        infos: of the reset.
    """

    def __init__(self, env: BatchedEnv, infos: Mapping[str, NDArray[Any]]) -> None:
        batch, agents, period = env.num_envs, len(env.agents), env.settings.control_period
        self._env, self._period = env, period
        self._present = {"cost", "arrived", "min_distance"} <= set(infos)
        self._members = [env.fleet.agent(agent) for agent in env.agents]
        self._places: deque[FloatArray] = deque(maxlen=max(2, round(STILL_TIME / period) + 1))
        self._first = np.full((batch, agents), math.inf)  # s, of arrival
        self._values = {
            "collision": np.zeros(batch),
            "success": np.zeros(batch),
            "arrival_time": np.full(batch, math.nan),
            "min_distance": np.full(batch, math.inf),
            "deadlock": np.zeros(batch),
        }
        self._changed, self._infeasible, self._steps = np.zeros(batch), np.zeros(batch), np.zeros(batch)
        self._filtered = False

    def add(
        self,
        cycle: int,
        running: NDArray[np.bool_],
        over: NDArray[np.bool_],
        infos: Mapping[str, NDArray[Any]],
        policy: Policy,
    ) -> None:
        """Take account of a control period.

        Args:
            cycle: its number, from 1.
            running: (B,) environments whose episode was running until now.
            over: (B,) environments whose episode ends with it.
            infos: after it.
            policy: that acted; a safety filter says by agent (B,) how much it has changed inputs, `intervention`, and
                where its program was `infeasible`.
        """
        if not self._present:
            return
        values, arrived = self._values, infos["arrived"] > 0.5
        self._first = np.where(arrived & np.isinf(self._first), cycle * self._period, self._first)
        values["collision"][running & (infos["cost"] > 0.0).any(axis=1)] = 1.0
        nearest = np.minimum(values["min_distance"], infos["min_distance"].min(axis=1))
        values["min_distance"] = np.where(running, nearest, values["min_distance"])
        if intervention := getattr(policy, "intervention", None):
            self._filtered = True
            self._changed += np.where(running, np.mean(list(intervention.values()), axis=0), 0.0)
            self._steps += running
        if infeasible := getattr(policy, "infeasible", None):
            self._infeasible += np.where(running, np.mean(list(infeasible.values()), axis=0), 0.0)
        self._places.append(self._env.world.positions()[self._members])
        ended = running & over
        if not ended.any():
            return
        everybody = arrived.all(axis=1)
        mean = np.where(everybody, self._first.mean(axis=1), math.nan)
        values["arrival_time"] = np.where(ended, mean, values["arrival_time"])
        values["success"] = np.where(ended, everybody & (values["collision"] == 0.0), values["success"])
        if len(self._places) == self._places.maxlen:
            moved = np.sqrt(((self._places[-1] - self._places[0]) ** 2).sum(axis=1)).T  # (B, N)
            still = (moved < STILL).all(axis=1) & ~everybody
            values["deadlock"] = np.where(ended, still, values["deadlock"])

    def result(self) -> dict[str, FloatArray]:
        """(E,) measurements by name; none in an environment without collisions."""
        if not self._present:
            return {}
        values = {"intervention": self._changed, "infeasible": self._infeasible}
        nothing = np.full(len(self._steps), math.nan)
        means = {name: sums / self._steps if self._filtered else nothing for name, sums in values.items()}
        return {**self._values, **means}


def summary(values: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Rates, means and extremes over episodes, with 95 % intervals: [low, high] of rates, half widths of means.

    None stands where there is none.

    Args:
        values: of `Outcomes.result`, of any number of episodes.
    """
    if not values:
        return {}
    times, filtered = values["arrival_time"][values["success"] > 0.5], not np.isnan(values["intervention"]).any()
    return {
        "collision_rate": float(values["collision"].mean()),
        "collision_ci95": wilson95(values["collision"]),
        "success_rate": float(values["success"].mean()),
        "success_ci95": wilson95(values["success"]),
        "arrival_time": float(times.mean()) if times.size else None,
        "arrival_time_ci95": interval95(times),
        "min_distance": float(values["min_distance"].min()),
        "deadlock_rate": float(values["deadlock"].mean()),
        "deadlock_ci95": wilson95(values["deadlock"]),
        "intervention": float(values["intervention"].mean()) if filtered else None,
        "intervention_ci95": interval95(values["intervention"]) if filtered else None,
        "infeasible": float(values["infeasible"].mean()) if filtered else None,
    }


def wilson95(values: FloatArray | Sequence[float]) -> list[float]:
    """Wilson's 95 % interval [low, high] of a rate, from zeros and ones.

    Source: E. B. Wilson, Probable Inference, the Law of Succession, and Statistical Inference, JASA 22, 1927.
    """
    count, rate = len(values), float(np.mean(values))
    center = (rate + Z95**2 / (2 * count)) / (1 + Z95**2 / count)
    half = Z95 / (1 + Z95**2 / count) * math.sqrt(rate * (1 - rate) / count + Z95**2 / (4 * count**2))
    return [0.0 if rate == 0.0 else max(0.0, center - half), 1.0 if rate == 1.0 else min(1.0, center + half)]


def interval95(values: FloatArray) -> float | None:
    """Half width of the 95 % confidence interval of the mean (Student's t); None for a single value.

    The quantile is Cornish and Fisher's expansion (Abramowitz and Stegun, 26.7.5), within 1 % from 4 values on; exact
    for 2 and 3.
    """
    if len(values) < 2:
        return None
    z, n = statistics.NormalDist().inv_cdf(0.975), len(values) - 1
    if n < 3:
        t = (12.7062, 4.3027)[n - 1]
    else:
        t = z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        t += (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
    return t * float(np.std(values, ddof=1)) / math.sqrt(len(values))
