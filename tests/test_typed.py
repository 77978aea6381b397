"""Values of the command line and of files, by declared types."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import pytest

from khop_env.env import Settings
from khop_env.tasks import Consensus, Formation, LeaderFollowing, Task
from khop_env.typed import environment_arguments, environment_types, fitting_values, typed_values

KINDS = {
    "number": float,
    "maybe": float | None,
    "count": int,
    "flag": bool,
    "text": str,
    "mode": Literal["agent", "team"],
    "names": int | Sequence[str | int] | None,
    "follow": Mapping[str, str] | None,
    "points": list | None,
    "hidden": tuple[int, ...],
}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("number=1e-3", 1e-3),
        ("number=2", 2.0),
        ("maybe=none", None),
        ("maybe=0.5", 0.5),
        ("count=-3", -3),
        ("count=1_000", 1000),
        ("flag=true", True),
        ("flag=False", False),
        ("text=0.5", "0.5"),
        ("text=a=b", "a=b"),
        ("mode=team", "team"),
        ("names=2", 2),
        ("names=a", ("a",)),
        ("names=a+b", ("a", "b")),
        ("names=[0, 3]", (0, 3)),
        ("names=none", None),
        ('follow={"a": "b"}', {"a": "b"}),
        ("points=[[0, 0], [1, 0.5]]", [[0, 0], [1, 0.5]]),
        ("hidden=64+32", (64, 32)),
        ("hidden=64", (64,)),
    ],
)
def test_texts(text, value):
    found = typed_values([text], "--set", KINDS)[text.partition("=")[0]]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("number=fast", "--set number: expected a number; got 'fast'"),
        ("number=nan", "--set number: expected a number; got 'nan'"),
        ("number=true", "--set number: expected a number; got 'true'"),
        ("number=none", "--set number: expected a number; got 'none'"),
        ("count=1.5", "--set count: expected an integer; got '1.5'"),
        ("count=true", "--set count: expected an integer; got 'true'"),
        ("flag=1", "--set flag: expected true or false; got '1'"),
        ("mode=teem", "--set mode: expected 'agent' or 'team'; got 'teem'; did you mean 'team'?"),
        ("names=1.5", "--set names: expected an integer or a list such as a+b or none; got '1.5'"),
        ("points=[[0, 0], [1]]", "--set points: expected a list such as [[0, 0], [1, 0]] or none; got"),
        ("points=abc", "--set points: expected a list such as"),
        ('follow={"a": 1}', '--set follow: expected a mapping such as {"a": "b"} or none; got'),
        ("hidden=a+b", "--set hidden: expected a list such as a+b; got 'a+b'"),
        ("nubmer=1", "--set nubmer=1: no argument 'nubmer'; did you mean 'number'?"),
        ("number", "--set takes NAME=VALUE; got 'number'"),
        ("text=" + "[" * 100_000, None),
    ],
)
def test_wrong_texts(text, said):
    if said is None:
        assert typed_values([text], "--set", KINDS)
        return
    with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
        typed_values([text], "--set", KINDS)


def test_values_of_files():
    assert fitting_values({"number": 1, "hidden": [4]}, "here", KINDS) == {"number": 1.0, "hidden": (4,)}
    with pytest.raises(ValueError, match=r"^here: hidden: expected a list such as a\+b; got '4'$"):
        fitting_values({"hidden": "4"}, "here", KINDS)


@pytest.mark.parametrize("task", [Consensus, Formation, LeaderFollowing])
def test_every_default_of_the_library_fits_its_type(task):
    made, kinds = task(), environment_types(task)
    values = {field.name: getattr(made, field.name) for field in dataclasses.fields(task) if field.init}
    settings = {field.name: field.default for field in dataclasses.fields(Settings)}
    assert set(kinds) == {*values, *settings}
    assert {"reward", "effort", "success_radius"} <= set(values)
    assert fitting_values({**values, **settings}, "defaults", kinds) == {**values, **settings}


def test_points_of_a_formation_are_an_array():
    found = environment_arguments(["points=[[0, 0], [1, 0]]"], Formation)
    assert np.asarray(Formation(**found).points).shape == (2, 2)


def test_tasks_with_an_init_of_their_own():
    class Plain(Task):
        def __init__(self, goal: float = 1.0, other=None):
            self.goal = goal

        def evaluate(self, world):
            raise NotImplementedError

    assert environment_arguments(["goal=2", "other=[1]", "dt=0.01"], Plain) == {"goal": 2.0, "other": [1], "dt": 0.01}
    with pytest.raises(ValueError, match="no argument 'goal'"):  # an object has its own already
        environment_arguments(["goal=2"], Plain())
