"""Scenario files that somebody's hand slipped in: whatever is written, the answer is a scenario or a named mistake."""

import random
import re
from pathlib import Path

import numpy as np
import pytest
from test_files import MINIMAL, everything

from agents import LAWS, LawError, make_law
from khop_env.observers import DesignError, SolveError
from khop_env.results import design_report
from khop_env.scenarios import Scenario, mixed_fleet
from khop_env.scenarios.files import ScenarioFileError, read_scenario, write_scenario

VALUES = (
    "0", "-1", "1", "2.5", "7", "1e9", "1000000000", "-1e-9", "1e-300", "1e300", "nan", "-inf", "inf", "true", '"tanh"',
    '"auto"', '"\\u001b[2J"', '"../../x"', "[]", "[1, 2]", "[[0, 1]]", "{}", "{a = 1}", "1979-05-27", "9" * 30,
    "9" * 5000, "0x" + "f" * 5000, "[" * 400 + "]" * 400, "[" * 5000, '"' + "x" * 10_000 + '"',
)  # fmt: skip
NUMBER = re.compile(r"(?<![\w.])-?\d[\w.+-]*")


def slipped(text: str, rng: random.Random) -> str:
    """The text after one to three slips: another value or number, a line lost, twice, or elsewhere, letters changed."""
    for _ in range(rng.randint(1, 3)):
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        kind = rng.randrange(6)
        if kind == 0 and "=" in lines[at]:
            lines[at] = f"{lines[at].partition('=')[0]}= {rng.choice(VALUES)}"
        elif kind == 1 and (found := [*NUMBER.finditer(lines[at])]):
            number = rng.choice(found)
            lines[at] = lines[at][: number.start()] + rng.choice(VALUES) + lines[at][number.end() :]
        elif kind == 2:
            del lines[at]
        elif kind == 3:
            lines.insert(at, lines[at])
        elif kind == 4:
            lines.insert(at, lines.pop(rng.randrange(len(lines))))
        elif lines[at]:
            place = rng.randrange(len(lines[at]))
            lines[at] = (
                lines[at][:place] + chr(rng.choice((0, 27, 34, 35, 61, 91, 93, 233, 128512))) + lines[at][place:]
            )
        text = "\n".join(lines)
    return text


def outcome(path: Path) -> Scenario | str:
    """The scenario in a file, or what is said of it."""
    try:
        return read_scenario(path, laws=LAWS)
    except ScenarioFileError as error:
        return str(error)


def play(scenario: Scenario) -> bool:
    """Two steps, and whether they could be taken; anything but a named refusal is raised."""
    report = design_report(scenario)
    if not report["feasible"]:
        return False
    try:
        simulator = scenario.build(law=make_law(scenario.law))
        for _ in range(2):
            simulator.step(scenario.dt)
    except (DesignError, LawError, SolveError):
        return False
    assert np.isfinite(simulator.x).all()
    return True


@pytest.mark.parametrize("original", [MINIMAL, write_scenario(everything()), write_scenario(mixed_fleet())])
def test_a_slip_of_the_hand_is_a_scenario_or_a_named_mistake(original, tmp_path):
    rng = random.Random(5)
    path = tmp_path / "mine.toml"
    found = []
    for _ in range(400):
        path.write_text(slipped(original, rng), encoding="utf-8")
        found.append(outcome(path))
    for message in (one for one in found if isinstance(one, str)):
        assert message.startswith(str(path))
        assert len(message) < 20_000
        assert message.replace("\n", "").isprintable()
    scenarios = [one for one in found if isinstance(one, Scenario)]
    assert 10 < len(scenarios) < 390
    played = [play(scenario) for scenario in scenarios[:15]]
    assert any(played)
