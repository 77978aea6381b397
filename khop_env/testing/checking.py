"""Run all checks of an environment."""

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
    "restore": runs.restored,
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
"""Names of all checks, in the order in which they run."""


def check_environment(
    env: Any,
    *,
    steps: int = 300,
    seed: int = 0,
    skip: Collection[str] = (),
    progress: Callable[[float], None] | None = None,
) -> Report:
    """Check that an environment fulfils the contract of this library's environments.

        check_environment(lambda: consensus_v0.parallel_env(my_scenario)).raise_if_failed()

    Args:
        env: a PettingZoo ParallelEnv that was never reset, or better a function that returns a new one at each call. An
            object is copied; if it can't be copied, checks that need several environments are skipped.
        steps: number of steps of episodes and comparisons.
        seed: first seed of environments and actions.
        skip: names from `CHECKS` to leave out, e.g. "other_seed" and "unseeded" if nothing is random.
        progress: called with the completed fraction.

    Returns:
        The result of each check: passed; failed and where; or skipped and why.

    Raises:
        ValueError: if `env` isn't a ParallelEnv, steps < 1, seed < 0, or a name in `skip` is unknown.
    """
    for name in skip:
        if name not in _CHECKS:
            raise ValueError(f"no check {name!r}; {did_you_mean(name, _CHECKS)}")
    if steps < 1 or seed < 0:
        raise ValueError(f"steps must be at least 1 and seed not negative; got steps={steps} and seed={seed}")
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
