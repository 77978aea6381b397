"""Checks that compare runs. A check raises Fault or Skip, or returns; reports print its docstring."""

from __future__ import annotations

import copy
import itertools
import pickle
import random
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.spaces import Space
from pettingzoo import ParallelEnv

from khop_env.objects import described
from khop_env.testing.equality import arrays, difference
from khop_env.testing.subject import (
    Fault,
    Subject,
    called,
    first_difference,
    global_generators_seeded,
    play,
    record,
)

_SHORT = 20  # steps, if a few are enough


def same_seed(subject: Subject) -> None:
    """The same seed gives the same bits, over episodes."""

    def play_once() -> list[dict[str, Any]]:
        return record(subject.any(), subject.steps, subject.seed, reset_seed=subject.seed)

    def with_seeded_globals() -> list[dict[str, Any]]:
        with global_generators_seeded():
            return play_once()

    if found := first_difference(play_once(), play_once()):
        drawn = first_difference(with_seeded_globals(), with_seeded_globals()) is None
        raise Fault(found + ("; numbers are drawn from NumPy's or Python's global generator" if drawn else ""))


def other_seed(subject: Subject) -> None:
    """Different seeds give different episodes."""
    first, second = (
        record(subject.any(), _SHORT, subject.seed, reset_seed=seed) for seed in (subject.seed, subject.seed + 1)
    )
    if first_difference(first, second) is None:
        raise Fault(
            f"seeds {subject.seed} and {subject.seed + 1} give the same {_SHORT} steps; leave this check out if the "
            "environment draws no random numbers"
        )


def unseeded(subject: Subject) -> None:
    """Copies that were never seeded differ."""
    env = subject.another()
    made = {"two environments": [env, subject.another()]}
    for text, method in (("two deep copies", copy.deepcopy), ("two pickled copies", _pickled)):
        try:
            made[text] = [method(env), method(env)]
        except Exception:
            continue  # the checks deepcopy and pickle report it
    for text, pair in made.items():
        first, second = (record(copied, _SHORT, subject.seed) for copied in pair)
        if first_difference(first, second) is None:
            raise Fault(
                f"{text} that were never seeded play the same {_SHORT} steps; leave this check out if the environment "
                "draws no random numbers, or was seeded before"
            )


def global_random(subject: Subject) -> None:
    """NumPy's and Python's global generators stay unmoved."""
    env = subject.any()
    with global_generators_seeded():
        before = np.random.get_state(), random.getstate()  # noqa: NPY002
        for number, step in enumerate(play(env, subject.steps, subject.seed, reset_seed=subject.seed)):
            now = np.random.get_state(), random.getstate()  # noqa: NPY002
            for text, first, second in zip(("NumPy", "Python"), before, now, strict=True):
                if difference(first, second) is not None:
                    raise Fault(f"{called(number, step)} moves {text}'s global generator")


def memory(subject: Subject) -> None:
    """Returned arrays are never written or shared later."""
    env = subject.any()
    played = itertools.islice(play(env, _SHORT, subject.seed, reset_seed=subject.seed), 4)
    kept = {called(number, step): step for number, step in enumerate(played)}
    if _has_state(env):
        kept |= {f"state(), {nth} call": {"state": env.state()} for nth in ("first", "second")}
    frozen = copy.deepcopy(kept)
    for _ in play(env, 3, subject.seed, begin=False):
        pass
    env.reset()
    for text, step in kept.items():
        if found := difference(frozen[text], step, "returned"):
            raise Fault(f"the return value of {text} is written to later: {found}")
    for (text, step), (later, then) in itertools.combinations(kept.items(), 2):
        for key, other in itertools.product(step, then):
            if step[key] is then[other] or _overlap(step[key], then[other]):
                raise Fault(f"{text} and {later} return the same memory ({key} and {other})")
        for agent, other in itertools.combinations(step.get("observations", {}), 2):
            if _overlap(step["observations"][agent], step["observations"][other]):
                raise Fault(f"{text}: the observations of {agent!r} and {other!r} share memory")
    _survives_writing(subject)


def pickled(subject: Subject) -> None:
    """A pickled copy continues bit for bit, independently."""
    _continues(subject, _pickled)


def deepcopied(subject: Subject) -> None:
    """A deep copy continues bit for bit, independently."""
    _continues(subject, copy.deepcopy)


def restored(subject: Subject) -> None:
    """A saved state is restored bit for bit, in another environment."""
    env = subject.own()

    def into_another(env: ParallelEnv) -> ParallelEnv:
        twin = subject.own()
        twin.set_state(env.get_state())
        return twin

    _continues(subject, into_another, env)


def _survives_writing(subject: Subject) -> None:
    """Check that writing into returned values or actions has no effect."""
    subject.require_repeatable()
    runs: list[list[dict[str, Any]]] = [[], []]
    for run, spoil in zip(runs, (False, True), strict=True):
        with global_generators_seeded():
            try:
                for step in play(subject.any(), _SHORT, subject.seed, reset_seed=subject.seed):
                    run.append(copy.deepcopy(step))
                    if spoil:
                        _spoil(step)
            except Exception as error:
                if not spoil:
                    raise
                text = "writing into returned values or actions makes a call raise"
                raise Fault(f"{text} {described(error)}") from None
    if found := first_difference(*runs):
        raise Fault(f"writing into returned values or actions changes later steps: {found}")


def _spoil(step: dict[str, Any]) -> None:
    for array in arrays(list(step.values())):
        if array.flags.writeable and array.dtype != object:
            array[...] = np.nan if array.dtype.kind == "f" else 0
    for key, value in step.items():
        if key != "actions" and value:
            value["__all__"] = value.pop(next(iter(value)))


def _continues(subject: Subject, method: Callable[[ParallelEnv], ParallelEnv], env: ParallelEnv | None = None) -> None:
    """Compare a copy made in mid-episode with the original, across the end of the episode and unseeded resets."""
    subject.require_repeatable()
    env = subject.any() if env is None else env
    for _ in play(env, 4, subject.seed, reset_seed=subject.seed):
        pass
    twin = method(env)
    runs = []
    for copied in (env, twin):
        with global_generators_seeded():
            try:
                runs.append(record(copied, subject.steps, subject.seed + 1, begin=False))
            except Exception as error:
                if copied is env:
                    raise
                raise Fault(f"copied after 4 steps, the copy can't continue: {described(error)}") from None
    if found := first_difference(*runs):
        raise Fault(f"copied after 4 steps, original and copy differ: {found}")


def _pickled(env: ParallelEnv) -> ParallelEnv:
    return pickle.loads(pickle.dumps(env))


def _overlap(first: Any, second: Any) -> bool:
    pairs = itertools.product(arrays(first), arrays(second))
    return any(np.shares_memory(a, b) for a, b in pairs if a.flags.writeable or b.flags.writeable)


def _has_state(env: ParallelEnv) -> bool:
    """True if the environment implements state(); that of PettingZoo's base class raises."""
    return isinstance(getattr(env, "state_space", None), Space) or type(env).state is not ParallelEnv.state
