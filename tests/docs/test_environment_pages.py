"""Pages of environments are made from the library, and agree with it."""

import importlib
import itertools
import re
import sys
from pathlib import Path

import pytest

import khop_env
from khop_env.catalog import ENVIRONMENTS

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "docs"))

from environment_page import environment_page  # noqa: E402  (docs/environment_page.py)
from films import FILMS  # noqa: E402

LARGEST = 700_000  # bytes of a film
COLUMN = re.compile(r"^\| (\d+) \| `([\w.]+)` \| (\w*) \| (\S+) to (\S+) \| (\S+) \|$", re.MULTILINE)
SLOT = re.compile(r"^\| (\d+)(?: to (\d+))? \| (\d+) to (\d+) \| (.*?) \| (\d*) \|", re.MULTILINE)


@pytest.fixture(scope="module", params=ENVIRONMENTS)
def page(request):
    """Name and text of each page."""
    return request.param, environment_page(request.param)


def test_tables_are_the_layouts(page):
    """The default environment's, with bounds, and under a network, in this order."""
    name, text = page
    tables = re.split(r"(?m)^\| Column \|.*\n", text)[1:]
    network = () if name == "navigation_v0" else ({"network": "wifi", "bounds": True},)
    for table, arguments in zip(tables, ({}, {"bounds": True}, *network), strict=True):
        env = khop_env.make(name, **arguments)
        observations, _ = env.reset(seed=0)
        agent = env.possible_agents[0]
        layout = env.layout(agent)
        rows = COLUMN.findall(table)
        for number, column, unit, low, high, value in rows:
            field = layout.fields[int(number)]
            assert (column, unit) == (field.name, field.unit)
            assert (float(low), float(high)) == (float(f"{field.low:g}"), float(f"{field.high:g}"))
            assert float(value) == pytest.approx(observations[agent][int(number)], rel=5e-3)
        slots = {column.partition(".")[0] for _, column, *_ in rows if column.startswith("slot")}
        assert len(slots) == 1
        others = [column for column in layout.names if column.startswith("slot") and column.split(".")[0] not in slots]
        assert len(rows) == len(layout) - len(others)


def test_slots_cover_the_rest(page):
    name, text = page
    env = khop_env.make(name)
    layout = env.layout(env.possible_agents[0])
    rows = SLOT.findall(text.partition("| Slot |")[2].partition("\n\n")[0])
    ends = [len([column for column in layout.names if not column.startswith("slot")])]
    for slot, last, first, end, agent, hops in rows:
        assert int(first) == ends[-1]
        assert layout.names[int(first)] == f"slot{slot}.valid"
        assert layout.names[int(end)].startswith(f"slot{last or slot}.")
        if int(slot) < len(layout.slots):
            assert (agent, hops) == (f"`{layout.slots[int(slot)].id}`", str(layout.slots[int(slot)].hops))
        else:
            assert agent == "none: zeros"
        ends.append(int(end) + 1)
    assert ends[-1] == len(layout)


@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.parametrize("scenario", ["mixed_fleet", "corridor:continuous=true", "crossing"])
def test_every_column_is_described(name, scenario):
    """By a row of the tables in the module's documentation string."""
    text = importlib.import_module(f"khop_env.{name}").__doc__
    rows = re.findall(r"^\| ((?:own|goal|obstacle|radius|slot)\S*)", text, re.MULTILINE)
    by_messages = {"message_size": 2} if scenario == "crossing" else {}
    env = khop_env.make(name, scenario, bounds=True, actuator="lag", **by_messages)
    models = env.batched.world.fleet.models
    states = "|".join({state for model in models for state in model.states})
    known = {
        "state": rf"(?:{states})(?:\.cos|\.sin)?",
        "input": "|".join({each for model in models for each in model.inputs}),
        "type": "|".join({model.type for model in models}),
    }
    patterns = []
    for row in rows:
        row = re.sub(r"(?<=slot|acle)0", r"\\d+", row.rstrip(",").replace(".", r"\."))  # slot0, obstacle0
        row = re.sub(r"\\\.x$", r"\\.[xyz]", row)  # position.x, .y
        row = re.sub(r"\\\.0$", r"\\.\\d+", row)  # message.0 ...
        patterns.append(re.sub(r"<(\w+)>", lambda found: f"(?:{known[found[1]]})", row))
    for agent in env.possible_agents:
        for column in env.layout(agent).names:
            assert "padding" in column or any(re.fullmatch(each, column) for each in patterns), column


def test_headings_are_consecutive(page):
    levels = [len(found) for found in re.findall(r"^(#+) ", re.sub(r"(?ms)^```.*?^```", "", page[1]), re.MULTILINE)]
    assert levels[0] == 1
    assert all(later <= level + 1 for level, later in itertools.pairwise(levels))


def test_the_python_runs(page, capsys):
    for code in re.findall(r"(?ms)^```python\n(.*?)^```", page[1]):
        exec(compile(code, page[0], "exec"), {})
    assert capsys.readouterr().out


def test_the_film_is_there(page):
    from PIL import Image

    name, text = page
    path = ROOT / "docs" / "images" / f"{name}.gif"
    assert f"](../images/{path.name})" in text
    assert f"khop run {name} {FILMS[name].options} --video film.gif" in text
    assert path.stat().st_size < LARGEST
    with Image.open(path) as film, Image.open(path.with_name(f"{name}_small.png")) as small:
        assert film.n_frames >= 20
        assert small.size == (360, 360)


def test_policies_are_shipped(page):
    from agents.learning import shipped

    name, text = page
    listed = re.findall(r"(?m)^- `ppo:pretrained/(\w+)` for `([^`]+)`(?: over `([^`]+)`)?$", text)
    of_it = [policy for policy in shipped().values() if policy.environment == name]
    assert listed == [(policy.name, policy.scenario, policy.network or "") for policy in of_it]
    assert f"\nkhop run {name} --controller ppo:pretrained\n" in text


def test_the_comparison_is_true(page):
    """Of the overview: who acts, how long, where."""
    name, _ = page
    env = khop_env.make(name)
    task, settings = env.batched.task, env.batched.settings
    overview = (ROOT / "docs" / "environments" / "index.md").read_text(encoding="utf-8")
    table = re.search(r"(?ms)^\| \| .*?\n\n", overview)[0]
    rows = [re.split(r" *\| *", line)[1:-1] for line in table.splitlines() if line]
    column = rows[0].index(f"`{name}`")
    said = {row[0]: row[column] for row in rows[1:]}
    assert re.search(r"\d+", said["Who acts"])[0] == str(len(env.possible_agents))
    duration = settings.max_cycles * settings.control_period
    assert said["Episode"].startswith(f"{duration:g} s, {settings.max_cycles} actions")
    assert said["Default scenario"] == f"`{task.default_scenario}`"


def test_views_are_made_as_said():
    import gymnasium

    overview = (ROOT / "docs" / "environments" / "index.md").read_text(encoding="utf-8")
    table = overview.partition("| View |")[2].partition("\n\n")[0]
    calls = re.findall(r"(?m)^\| (\w+) \| `([^`]+)` \|", table)
    assert [name for name, _ in calls] == ["parallel", "AEC", "batched", "vector", "SB3", "joint"]
    for _, call in calls:
        eval(call, {"khop_env": khop_env, "gymnasium": gymnasium, "consensus_v0": khop_env.consensus_v0})
