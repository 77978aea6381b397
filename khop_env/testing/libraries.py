"""Environment checks of PettingZoo, Gymnasium and Stable-Baselines3."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
import warnings
from collections.abc import Iterator

import numpy as np
from pettingzoo.utils import parallel_to_aec

from khop_env.env import JointEnv, KHopEnv
from khop_env.extras import how_to_install
from khop_env.testing.subject import Skip, Subject

# Expected warnings in environments of this library: PettingZoo's tests pass an unknown option "options" to `reset`;
# observations may be ragged; padding is always zero.
_ON_PURPOSE = (
    r"reset\(\) ignores the option 'options'",
    "Agents have different observation space sizes|Observations are different shapes",
    "(.*A Box observation space|Agent's) maximum and minimum .*values are equal",
)


def pettingzoo(subject: Subject) -> str:
    """PettingZoo's parallel_api_test and api_test."""
    with warnings.catch_warnings():  # on import PettingZoo uses its own deprecated functions
        warnings.simplefilter("ignore", DeprecationWarning)
        from pettingzoo.test import api_test, parallel_api_test
    with _collected(subject) as notes:
        parallel_api_test(subject.any(), num_cycles=subject.steps)
        api_test(parallel_to_aec(subject.any()), num_cycles=subject.steps)
    return "; ".join(notes)


def pettingzoo_seeds(subject: Subject) -> str:
    """PettingZoo's parallel_seed_test and seed_test."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from pettingzoo.test import parallel_seed_test, seed_test
    with _collected(subject) as notes:
        parallel_seed_test(subject.another, num_cycles=subject.steps)
        seed_test(lambda: parallel_to_aec(subject.another()), num_cycles=subject.steps)
    return "; ".join(notes)


def gymnasium(subject: Subject) -> str:
    """Gymnasium's check_env, with the team as one agent."""
    from gymnasium.utils.env_checker import check_env

    with _collected(subject) as notes:
        check_env(_team(subject), skip_render_check=True)
    return "; ".join(notes)


def sb3(subject: Subject) -> str:
    """SB3's check_env, with the team as one agent."""
    team = _team(subject)
    if importlib.util.find_spec("stable_baselines3") is None:
        raise Skip(f"Stable-Baselines3 isn't installed: {how_to_install('rl')}")
    from stable_baselines3.common.env_checker import check_env

    with _collected(subject) as notes:
        check_env(team)
    return "; ".join(notes)


def _team(subject: Subject) -> JointEnv:
    if not isinstance(subject.env.unwrapped, KHopEnv):
        raise Skip("a ParallelEnv isn't a gymnasium.Env; only those of khop_env can be checked as one agent")
    return JointEnv(subject.own())


@contextlib.contextmanager
def _collected(subject: Subject) -> Iterator[list[str]]:
    """Collect unexpected warnings without duplicates, and discard printed output."""
    notes: list[str] = []
    expected = _ON_PURPOSE if isinstance(subject.env.unwrapped, KHopEnv) else ()
    with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stdout(io.StringIO()), np.errstate():
        warnings.simplefilter("always")
        yield notes
    for warning in caught:
        text = re.sub(r"\x1b\[\d+m", "", " ".join(str(warning.message).split()))
        if text not in notes and not any(re.match(pattern, text) for pattern in expected):
            notes.append(text)
