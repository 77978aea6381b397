"""Python objects by name: loading, and messages if that fails."""

import inspect
import os
import pickle
import sys

import pytest

from khop_env.objects import described, load_object, split_specs


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with files of a user, whose modules are unloaded afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    known = set(sys.modules)
    (tmp_path / "my_parts.py").write_text(
        "LENGTH = 3\n\n\nclass Part:\n    @staticmethod\n    def make():\n        return LENGTH\n"
    )
    (tmp_path / "my_things.py").write_text("from my_parts import LENGTH, Part\n\nvalue = LENGTH + 1\n")
    (tmp_path / "broken.py").write_text("import json\n\njson.loads('{')\n")
    (tmp_path / "misspelt.py").write_text("x = 1\nif x = 2:\n    pass\n")
    (tmp_path / "needy.py").write_text("import no_such_package\n")
    (tmp_path / "leaving.py").write_text("import sys\n\nsys.exit(3)\n")
    yield tmp_path
    for name in set(sys.modules) - known:
        del sys.modules[name]


def test_of_modules_and_of_files_in_the_working_directory_and_elsewhere(folder):
    assert load_object("my_things:value") == 4
    assert load_object("my_things.py:value") == 4
    assert load_object("my_parts:Part.make")() == 3
    assert load_object("json.decoder:JSONDecoder").__name__ == "JSONDecoder"
    assert load_object("json.decoder").__name__ == "json.decoder"
    (folder / "apart").mkdir()
    (folder / "apart" / "their_parts.py").write_text("LENGTH = 7\n")
    (folder / "apart" / "their_things.py").write_text(
        "from their_parts import LENGTH\n\n\nclass Thing:\n    size = LENGTH\n"
    )
    thing = load_object(f"{folder / 'apart' / 'their_things.py'}:Thing")
    assert thing.size == 7  # a file finds what lies beside it
    assert type(pickle.loads(pickle.dumps(thing()))) is thing
    assert load_object("apart/their_things.py:Thing") is thing  # and is imported once


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "my_thing:value",
            "no module 'my_thing', neither installed nor in the working directory; a file's name ends in .py",
        ),
        ("json.no_such:value", "no module 'json.no_such', neither"),
        ("my_thing.py:value", "no file 'my_thing.py' .relative to "),
        ("my_things:valeu", "my_things has no 'valeu'; it has LENGTH, Part, value"),
        ("my_things.py:Part.build", "my_things.py: Part has no 'build'; it has make"),
        ("paper:", "'paper:' names no Python object|no module 'paper'"),
        ("a b:c", "'a b' isn't the name of a Python object; expected my_module:name or my_file.py:name"),
        ("", "'' isn't the name of a Python object"),
        ("broken:x", r"importing broken raised JSONDecodeError: Expecting .* \(broken.py, line 3, in <module>\)"),
        ("broken.py:x", r"importing broken.py raised JSONDecodeError: Expecting .* \(broken.py, line 3, in <module>\)"),
        ("misspelt.py:x", r"raised SyntaxError: invalid syntax.* \(misspelt.py, line 2\)"),
        (
            "needy:x",
            r"importing needy raised ModuleNotFoundError: No module named 'no_such_package' \(needy.py, line 1, ",
        ),
        ("needy.py:x", r"raised ModuleNotFoundError: No module named 'no_such_package' \(needy.py, line 1, "),
        ("leaving:x", r"importing leaving raised SystemExit: 3 \(leaving.py, line 3, in <module>\)"),
    ],
)
def test_what_is_not_there_or_cannot_be_imported(name, message, folder):
    with pytest.raises(ValueError, match=message):
        load_object(name)


def test_a_file_that_raised_is_read_again_once_it_is_mended(folder):
    for _ in range(2):
        with pytest.raises(ValueError, match="line 3") as info:
            load_object("broken.py:x")
        assert info.value.__cause__ is not None  # the user's own exception, with its traceback
    (folder / "broken.py").write_text("x = 5\n")
    assert load_object("broken.py:x") == 5


def test_a_file_named_like_a_module_that_is_there(folder):
    (folder / "pickle.py").write_text("x = 1\n")
    with pytest.raises(
        ValueError, match=r"pickle.py: a module named 'pickle' has been imported already; rename the file"
    ):
        load_object("pickle.py:x")
    (folder / "numpy.py").write_text("raise AssertionError\n")
    assert load_object("numpy:pi") > 3  # what is installed goes before what lies in the working directory


def test_where_an_exception_was_raised():
    with pytest.raises(pickle.UnpicklingError) as info:
        pickle.loads(b"x")
    line = inspect.currentframe().f_lineno - 1
    assert described(info.value) == (
        f"UnpicklingError: {info.value} ({os.path.relpath(__file__)}, line {line}, in "
        "test_where_an_exception_was_raised)"
    )
    assert described(ValueError("never raised")) == "ValueError: never raised"


class TestLists:
    def test_they_are_split_at_names(self):
        def split(text):
            return split_specs(text, "--networks", "network")

        assert split("ideal,wifi,lossy:loss=0.3,burst=5") == ["ideal", "wifi", "lossy:loss=0.3,burst=5"]
        assert split("ideal, period=0.1,wifi") == ["ideal:period=0.1", "wifi"]
        assert split("lossy:loss=0.3,lossy:loss=0.4,burst=2,espnow") == [
            "lossy:loss=0.3",
            "lossy:loss=0.4,burst=2",
            "espnow",
        ]
        assert split("tanh, linear:gain=2,cancel_drift=true ,my_file.py:Mine") == [
            "tanh",
            "linear:gain=2,cancel_drift=true",
            "my_file.py:Mine",
        ]

    @pytest.mark.parametrize(
        ("text", "problem"),
        [
            ("", "--networks: name at least one network; got ''"),
            ("ideal,,wifi", "there is nothing between two commas or at an end"),
            ("loss=1", "no network before 'loss=1'; write NAME:loss=1"),
            ("wifi,ideal,wifi", "--networks names 'wifi' twice"),
        ],
    )
    def test_mistakes_name_the_option(self, text, problem):
        with pytest.raises(ValueError, match=problem):
            split_specs(text, "--networks", "network")
