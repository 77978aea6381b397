"""Tune the scripted policies: gains by their return, and margins of those that keep apart by their collisions."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

from agents.evaluation import play
from agents.laws import LAWS
from agents.orca import Orca
from agents.policies import make_policy
from agents.policy import batched_of, describe
from agents.safety import SafetyFilter
from agents.scripted import LawPolicy
from agents.workers import Interrupted

SEEDS = range(10_000, 10_064)
"""Seeds of the tuning episodes; they differ from the default evaluation seeds."""

_FACTORS = (0.25, 0.5, 2**-0.5, 2**-0.25, 2**0.25, 2**0.5, 2.0, 4.0)
_STEPS = (-0.2, -0.1, -0.05, 0.05, 0.1, 0.2)  # of parameters from 0 to 1
_WORTH = 1e-4  # least relative improvement of an accepted change
_MARGINS = tuple(round(0.05 * q, 2) for q in range(21))  # m


@dataclass(frozen=True)
class Tuned:
    """The best parameters found.

    Attributes:
        parameters: values by name.
        mean_return: over the tuning episodes.
        default_return: mean return of the default parameters over the same episodes.
        trials: number of parameter sets evaluated.
        collision_rate: share of the tuning episodes with a collision, where margins were tuned.
        success_rate: share of those in which all arrived without a collision, likewise.
    """

    parameters: dict[str, Any]
    mean_return: float
    default_return: float
    trials: int
    collision_rate: float | None = None
    success_rate: float | None = None


def tune(
    env: object, law: str, seeds: Sequence[int] = SEEDS, *, progress: Callable[[float], None] | None = None
) -> Tuned:
    """Change one parameter after the other while the mean return increases.

    Positive parameters are scaled by up to 4, those from 0 to 1 shifted by up to 0.2, and booleans flipped.

    Args:
        env: an environment of khop_env; num_envs episodes run at a time.
        law: one of `LAWS`.
        seeds: seeds of the tuning episodes.
        progress: called with the estimated completed fraction.

    Returns:
        The best parameters found, to three digits. The search is local and may miss the global optimum.

    Raises:
        ValueError: if the mean return with default parameters isn't finite.
        Interrupted: on Ctrl-C; its `partial` holds the best parameters until then.
    """
    batched = batched_of(env)
    names = [field.name for field in fields(LAWS[law])]  # type: ignore[arg-type]
    signature = inspect.signature(LAWS[law]).parameters
    best = {name: signature[name].default for name in names}
    known: dict[tuple[Any, ...], float] = {}

    def value(parameters: dict[str, Any]) -> float:
        key = tuple(parameters.values())
        if key not in known:
            known[key] = float(play(batched, LawPolicy(law, parameters), seeds, name=law).returns.mean())
        return known[key]

    default = top = value(best)
    if not math.isfinite(default):
        raise ValueError(
            f"{law!r} with its default parameters has mean return {default} in {describe(batched).environment}"
        )
    improved, rounds = True, 0
    try:
        while improved and rounds < 6:
            improved, rounds = False, rounds + 1
            for number, name in enumerate(names):
                for candidate in _candidates(name, best[name]):
                    found = value({**best, name: candidate})
                    if found > top + _WORTH * abs(top):
                        best, top, improved = {**best, name: candidate}, found, True
                if progress is not None:
                    progress(1.0 - 0.5 ** (rounds - 1 + (number + 1) / len(names)))
    except KeyboardInterrupt:
        raise Interrupted(Tuned(best, top, default, len(known))) from None
    return Tuned(best, top, default, len(known))


def tune_margin(
    env: object, policy: str, seeds: Sequence[int] = SEEDS, *, progress: Callable[[float], None] | None = None
) -> Tuned:
    """The smallest margin of 0, 0.05, ... 1 m without a collision.

    If there is none, the one with the fewest collisions, and of those the one with the largest return. What is found
    holds for the tuning episodes: it is no bound, and where ages of messages have none, no constant is. Collisions are
    few, too, at margins at which nobody moves any more: look at the successes.

    Args:
        env: an environment of khop_env in which agents may collide; num_envs episodes run at a time.
        policy: a policy's name, e.g. "filter:margin=none" or "orca"; its own margin isn't used.
        seeds: seeds of the tuning episodes.
        progress: called with the completed fraction; the search may end early.

    Raises:
        ValueError: if the policy has no margin that could be tuned, or there are no collisions in the environment.
        Interrupted: on Ctrl-C; its `partial` holds the best margin until then.
    """
    batched, chosen = batched_of(env), make_policy(policy)
    if not isinstance(chosen, SafetyFilter | Orca) or chosen.margin == "certified":
        raise ValueError(
            f"policy {policy!r} has no margin to tune: name orca, or a safety filter that isn't certified, "
            "filter:margin=none or filter:margin=none,dead_reckoning=true"
        )

    def value(margin: float) -> tuple[float, float, float]:
        """Collision rate, mean return, success rate."""
        chosen.margin = margin
        episodes = play(batched, chosen, seeds, name=policy)
        if not episodes.outcomes:
            raise ValueError(f"no collisions are counted in {describe(batched).environment}; take navigation_v0")
        collision, success = (float(episodes.outcomes[name].mean()) for name in ("collision", "success"))
        return collision, float(episodes.returns.mean()), success

    best, top, trials = _MARGINS[0], value(_MARGINS[0]), 1
    default, interrupted = top[1], False
    try:
        for margin in _MARGINS[1:]:
            if top[0] == 0.0:
                break
            found, trials = value(margin), trials + 1
            if progress is not None:
                progress(trials / len(_MARGINS))
            if (-found[0], found[1]) > (-top[0], top[1]):
                best, top = margin, found
    except KeyboardInterrupt:
        interrupted = True
    result = Tuned({"margin": best}, top[1], default, trials, collision_rate=top[0], success_rate=top[2])
    if interrupted:
        raise Interrupted(result)
    return result


def _candidates(name: str, value: Any) -> list[Any]:
    if isinstance(value, bool):
        return [not value]
    if name == "shrink":
        return [round(min(1.0, max(0.0, value + step)), 2) for step in _STEPS]
    return [float(f"{value * factor:.3g}") for factor in _FACTORS]
