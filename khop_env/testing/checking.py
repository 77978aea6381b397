"""All checks of an environment, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from khop_env.objects import described
from khop_env.physics import did_you_mean
from khop_env.testing import leaks, libraries, runs, values, views
from khop_env.testing.report import Check, Report, Status
from khop_env.testing.subject import Fault, Skip, Subject

_CHECKS: dict[str, Callable[[Subject], str | None]] = {
    "spaces": values.spaces,
    "same_seed": runs.same_seed,
    "other_seed": runs.other_seed,
    "unseeded": runs.unseeded,
    "global_random": runs.global_random,
    "memory": runs.memory,
    "pickle": runs.pickled,
    "deepcopy": runs.deepcopied,
    "episode_end": values.episode_end,
    "nan_action": values.nan_action,
    "views": views.views,
    "leak": leaks.leak,
    "pettingzoo": libraries.pettingzoo,
    "pettingzoo_seeds": libraries.pettingzoo_seeds,
    "gymnasium": libraries.gymnasium,
    "sb3": libraries.sb3,
}

CHECKS = tuple(_CHECKS)
"""The names of all checks, in the order in which they run."""


def check_environment(
    env: Any,
    *,
    steps: int = 300,
    seed: int = 0,
    skip: Collection[str] = (),
    progress: Callable[[float], None] | None = None,
) -> Report:
    """Hold an environment against the contract of this library's own.

        check_environment(lambda: consensus_v0.parallel_env(my_scenario)).raise_if_failed()

    Args:
        env: a PettingZoo ParallelEnv that was never reset, or better a function that makes a fresh one at each call. An
            object is copied; what can't be copied skips the checks that need several.
        steps: of an episode, and of comparisons.
        seed: the first seed, of the environment and of actions.
        skip: names of checks to leave out, of `CHECKS`: e.g. "other_seed" and "unseeded" where nothing is random.
        progress: called with the fraction that is done.

    Returns:
        What passed, what failed and where, and what was skipped and why.

    Raises:
        ValueError: for something that is no ParallelEnv, fewer than one step, a negative seed, or an unknown check.
    """
    for name in skip:
        if name not in _CHECKS:
            raise ValueError(f"no check {name!r}; {did_you_mean(name, _CHECKS)}")
    if steps < 1 or seed < 0:
        raise ValueError(f"steps must be at least 1 and seed not negative; got {steps} and {seed}")
    subject = Subject(env, steps, seed)
    checks = []
    for number, (name, check) in enumerate(_CHECKS.items()):
        if progress is not None:
            progress(number / len(_CHECKS))
        claim = (check.__doc__ or "").partition("\n")[0].rstrip(".")
        if name in skip:
            checks.append(Check(name, claim, "skipped", "left out, as asked"))
        else:
            checks.append(Check(name, claim, *_result(check, subject)))
    return Report(subject.name, tuple(checks))


def _result(check: Callable[[Subject], str | None], subject: Subject) -> tuple[Status, str]:
    try:
        try:
            detail = check(subject)
        finally:
            subject.close()
    except Skip as reason:
        return "skipped", str(reason)
    except Fault as fault:
        return "failed", str(fault)
    except Exception as error:
        return "failed", described(error)
    return "passed", detail or ""
