"""The study of learning: its statistics and verdicts, and the command that trains, measures and writes the page."""

import dataclasses
import signal

import numpy as np
import pytest

from agents.learning import training
from agents.learning.config import TrainingConfig
from agents.learning.config_file import write_config
from benchmarks import publish_table, study_measured
from benchmarks.study import (
    DONE,
    EXPLORATION,
    FAST,
    FILTER,
    LOSSY,
    RECIPES,
    SCRIPTS,
    TASKS,
    Play,
    Run,
    StudyTask,
    finished,
    state_of,
)
from benchmarks.study import runs as runs_of
from benchmarks.study_measured import KEPT, Block, Row
from benchmarks.study_statistics import Difference, difference, iqm, iqm95
from benchmarks.study_table import AT_LEAST, PAY, WITHIN, findings, outcome_of, summary, table
from khop_env.registry import scenario
from khop_env.results import learning_curves
from khop_env.scenarios import Scenario

TINY = (
    StudyTask("consensus_v0", "paper", 4000, ("estimate", "oracle", "ideal")),
    StudyTask("leader_following_v0", "convoy", 4000, ("estimate",)),
)


def test_interquartile_means():
    """Of 8 values the middle four remain, of 5 the middle three; whole arrays count, and not their rows."""
    assert iqm(np.array([[1.0, 100.0, 4.0, 6.0], [5.0, 3.0, -50.0, 2.0]])) == (2.0 + 3.0 + 4.0 + 5.0) / 4
    assert iqm(np.array([7.0, 1.0, 2.0, 4.5, -9.0])) == (1.0 + 2.0 + 4.5) / 3
    values = np.random.default_rng(1).normal(size=(5, 100))
    low, high = iqm95(values)
    assert low < iqm(values) < high
    assert 0.1 < high - low < 0.4  # 500 values of variance 1: 2 * 1.96 * 1.1 / sqrt(500) = 0.19
    seeds_differ = iqm95(values + 10.0 * np.arange(5)[:, None])
    assert seeds_differ[1] - seeds_differ[0] > 5.0
    assert iqm95(np.full((1, 4), 2.0)) == (2.0, 2.0)


def row(name, play, returns, learned=True, seeds=None, **others):
    """A row with these returns (seeds, episodes); other measurements are 0.5 where they aren't given."""
    returns = np.atleast_2d(np.array(returns, float))
    keys = dict.fromkeys((*KEPT, "collision", "success", "arrival_time"), np.full_like(returns, 0.5))
    keys |= {"returns": returns} | {key: np.atleast_2d(value).astype(float) for key, value in others.items()}
    runs = [{key: values[number] for key, values in keys.items()} for number in range(len(returns))]
    return Row(name, play, tuple(range(len(returns)) if seeds is None else seeds), runs, learned)


@pytest.mark.parametrize(
    ("ours", "theirs", "word"),
    [
        ([[-1.0, -2.0], [-1.1, -2.1]], [[-3.0, -4.0], [-3.1, -4.1]], "better"),
        ([[-3.0, -4.0], [-3.1, -4.1]], [[-1.0, -2.0], [-1.1, -2.1]], "worse"),
        ([[0.0, -1.0], [-4.0, -5.0]], [[-3.0, -4.0], [-3.0, -4.0]], "no clear difference"),  # seeds differ
        ([[-1.0, -4.0], [-1.0, -4.0]], [[-3.0, -1.9], [-3.0, -1.9]], "no clear difference"),  # episodes differ
        ([[-1.0, -2.0], [-1.0, -2.0]], [[-1.0, -2.0], [-1.0, -2.0]], "level"),
        ([[-1.0, -2.0]], [[-3.0, -4.0]], "one seed only"),
    ],
)
def test_verdicts_need_both_intervals(ours, theirs, word):
    found = difference(row("a", Play(), ours), row("b", Play(), theirs))
    assert found.word == word
    assert found.mean == pytest.approx(np.mean(ours) - np.mean(theirs))
    assert found.percent == pytest.approx(100 * found.mean / abs(np.mean(theirs)))


@pytest.mark.parametrize(
    ("aim", "percent", "half", "outcome"),
    [
        (WITHIN, -2.0, 0.5, "reached"),
        (WITHIN, -2.0, 2.0, "open"),
        (WITHIN, -5.0, 1.0, "missed by 2 %"),
        (AT_LEAST, -2.0, 0.5, "missed by 2 %"),
        (AT_LEAST, -0.5, 2.0, "reached: level"),
        (AT_LEAST, -2.0, 2.5, "open"),
        (AT_LEAST, 2.0, 0.5, "reached: better"),
        (PAY, 2.0, 2.5, "missed: no clear difference"),
        (PAY, 2.0, 1.5, "reached: better"),
        (PAY, 2.0, None, "open: one seed"),
    ],
)
def test_what_became_of_an_aim(aim, percent, half, outcome):
    assert outcome_of(aim, Difference(percent / 10, 0.01, half and half / 10, -10.0), complete=True) == outcome
    later = "open: no clear difference yet" if outcome == "missed: no clear difference" else outcome
    assert outcome_of(aim, Difference(percent / 10, 0.01, half and half / 10, -10.0), complete=False) == later


def test_differences_are_of_common_seeds():
    ours = row("a", Play(), [[1.0, 2.0], [3.0, 4.0]], seeds=(0, 3))
    assert difference(ours, row("b", Play(), [[0.0, 0.0], [1.0, 1.0]], seeds=(1, 3))).mean == 2.5
    assert difference(ours, row("b", Play(), [[0.0, 0.0]], seeds=(1,))) is None
    script = row("tanh", Play(), [[0.0, 1.0]], learned=False)
    assert difference(ours, script).mean == 2.0  # with all seeds
    other = difference(row("tanh", Play(), [[-2.0, -1.5]], learned=False), script)
    assert str(other) == "-2.25 ± 3.2 over episodes (-450 %): no clear difference"  # 12.7 times 0.25


def scripted(play, value):
    return [row(name, play, [[value - number] * 4], learned=False) for number, name in enumerate(SCRIPTS)]


def test_the_aims_of_a_task():
    """Every comparison with its own reference: the best script there, the right network, the right observations."""
    noise = np.random.default_rng(3).normal(scale=0.01, size=(5, 4))
    ideal, lossy = Play(network="ideal"), Play(network=LOSSY)
    rows = [
        *scripted(Play(), -10.0),
        *scripted(Play("oracle"), -9.0),
        *scripted(Play("local"), -30.0),
        *scripted(ideal, -12.0),
        *scripted(Play(network="wifi"), -13.0),
        *scripted(lossy, -20.0),
        row("zero", Play(), [[-1.0] * 4], learned=False),
        row("estimate", Play(), noise - 9.5),
        row("oracle", Play("oracle"), noise[::-1] - 9.0),
        row("oracle", Play(), noise - 9.7),
        row("faster bounds", Play(rate=FAST), noise - 9.1),
        *scripted(Play(rate=FAST), -9.5),
        Row("residual", Play(), (), (), True),
        row("lossy", lossy, noise - 18.0),
        row("lossy + bounds", lossy, noise[::-1] - 17.0),
        row("ideal", lossy, noise - 19.0),
        row("ideal", ideal, noise - 19.0),
    ]
    block = Block(StudyTask("leader_following_v0", "mixed_fleet", 1), rows)
    found = {finding.title: finding for finding in findings(block)}
    text = "learned on estimates, against "
    assert found[text + "learned on the truth"].verdict == "missed by 2.6 %"  # -0.5 / 9, and 3 % are allowed
    assert found[text + "the best tuned script on estimates (tanh)"].verdict == "reached: better"
    assert found["residual, against the best tuned script on estimates (tanh)"].verdict == "open: not trained yet"
    assert found["lossy: with certificates in the observation, against without"].verdict == "reached: better"
    assert "-1 ± " in found["played lossy: trained ideal, against trained lossy"].result
    assert "-7 ± " in found["ideal, against the best script there (tanh)"].result
    assert found[text + "learned on neighbours only"].result == "not trained yet"
    lines = "\n".join(table(block))
    assert "PPO residual" not in lines
    assert "Not trained yet: " in lines
    assert "| PPO lossy | lossy | 5/5 | -18 ± " in lines
    assert "| **tanh**, on estimate |  | -10 ± 0 |" in lines
    assert "| linear, on oracle |  | -10 ± 0 |" in lines
    columns = [line.count("|") - line.count("\\|") - 1 for line in lines.splitlines() if line.startswith("|")]
    assert set(columns) == {7, 8}
    swapped = found["trained on the truth: played on estimates, against played on the truth"]
    assert swapped.verdict == "missed by 4.8 %"  # -0.7 / 9
    assert found["with bounds that fall at 20 1/s, against learned on the truth"].verdict == "reached"
    itself = "tanh on estimates{}, against itself on the truth"
    assert "(-11 %)" in found[itself.format("")].result
    assert "(-5.6 %)" in found[itself.format(", bounds at 20 1/s")].result
    assert "| **tanh**, on estimate, bounds at 20 1/s |  | -9.5 ± 0 |" in lines
    assert "| within 3 % of the truth | mixed_fleet | **missed** by 2.6 % | -5.6 ± " in "\n".join(summary([block]))
    assert "| better on three tasks | mixed_fleet | **missed** by 2 | 1 of 1 |" in "\n".join(summary([block]))


@pytest.mark.parametrize(("collided", "verdict"), [(0, "reached"), (1, "missed")])
def test_the_aims_of_navigation(collided, verdict):
    """Against the better script in each measure, inside the same filter; success is a rate."""
    inside, hit = Play(inside=FILTER), np.zeros((5, 4))
    hit[0, :collided] = 1.0
    rows = [
        row(FILTER, inside, [[3.0, 3.1, 3.2, 3.3]], False, success=[[1, 1, 0, 0]]),
        row(f"{FILTER}:go_to_goal", inside, [[3.2, 3.3, 3.4, 3.5]], False, success=[[0, 0, 0, 0]]),
        row("keep_right", Play(), [[9.0] * 4], False, success=[[1] * 4]),
        row("shielded", inside, [[3.3, 3.4, 3.5, 3.6]] * 5, collision=hit, success=[[1, 1, 1, 0]] * 5),
    ]
    block = Block(StudyTask("navigation_v0", "crossing", 1, ("shielded", "not shielded")), rows)
    collisions, returns, successes, *_ = findings(block)
    assert (collisions.verdict, returns.verdict) == (verdict, "reached: better")
    assert returns.title == "shielded, return against go_to_goal in the same filter"
    assert (successes.title, successes.verdict) == (
        "shielded, share of successes against keep_right in the same filter",
        "missed: no clear difference",
    )
    assert "+0.25 ± " in successes.result
    text = "\n".join(table(block))
    assert "| PPO shielded, in the filter | 5/5 | 3.45 ± 0.2 | " in text
    assert f" | 3.45 [3.3, 3.6] | {collided * 5:.1f} [" in text


def test_what_is_trained_first():
    order = [(run.task.scenario.partition(":")[0], run.recipe, run.seed) for run in runs_of()]
    assert len(order) == len(set(order)) == sum(len(RECIPES[name].seeds) for task in TASKS for name in task.recipes)
    first = order[:40]
    assert {recipe for _, recipe, _ in first} == {"estimate", "oracle"}
    assert [seed for *_, seed in first] == sorted(seed for *_, seed in first)
    assert {run[:2] for run in order[40:50]} == {("crossing", name) for name in ("shielded", "shielded residual")}
    assert {run[:2] for run in order[50:60]} == {("convoy", f"lossy attention{bounds}") for bounds in ("", " + bounds")}
    few = runs_of(TINY, range(1), ["ideal", "local"])
    assert [(run.task.scenario, run.recipe) for run in few] == [("paper", "ideal")]
    assert len({run.folder(publish_table.Path()) for run in runs_of()}) == len(order)


def test_settings_of_the_trainings():
    """Those that `khop train` uses by itself, and the network among the environment's arguments."""
    for run in runs_of(seeds=[2]):
        recipe = RECIPES[run.recipe]
        config = run.config()
        assert (config.seed, config.timesteps) == (2, run.task.timesteps)
        if run.recipe == "faster bounds":
            assert str(config.as_dict()["scenario"]).endswith("rate=20")
        else:
            assert config.scenario == run.task.scenario
        assert config.arguments.get("network") == recipe.network
        if run.recipe in EXPLORATION:
            continue
        assert config.observe == recipe.plays[0].observe
        assert recipe.plays[0].network in (recipe.network, *(["ideal"] if run.recipe == "random" else []))
    assert Run(TASKS[-1], "shielded", 0).config() == TrainingConfig.suited(
        "navigation_v0", scenario="crossing", shield="certified,announce=true", timesteps=TASKS[-1].timesteps
    )


def test_only_the_rates_of_the_bounds_are_others():
    for task in TASKS[:4]:
        own, faster = scenario(task.scenario), task.where(FAST)
        assert isinstance(faster, Scenario)
        assert faster.name.rpartition("=")[2] == "20"
        for kind in ("states", "inputs"):
            ours, theirs = (getattr(each.design, kind).bounds for each in (own, faster))
            assert [bound.final for bound in ours] == [bound.final for bound in theirs]
            assert {bound.rate for bound in theirs} in ({FAST}, {FAST} if kind == "states" else set())
        assert faster.disturbance == own.disturbance
        assert np.array_equal(faster.initial.radius, own.initial.radius)
        assert task.where(None) == task.scenario


@pytest.mark.parametrize("text", [None, "", "12", "{}", '{"seconds": "long", "commit": ""}', '{"seconds": 1.5'])
def test_a_training_whose_mark_is_damaged_has_not_finished(tmp_path, text):
    run = Run(TINY[0], "estimate", 0)
    folder = run.folder(tmp_path)
    folder.mkdir(parents=True)
    assert state_of(run, tmp_path).kind == "missing"
    (folder / "config.toml").write_text(write_config(run.config(), {}))
    if text is not None:
        (folder / DONE).write_text(text)
    assert finished(folder) is None
    assert state_of(run, tmp_path).kind == "missing"
    (folder / DONE).write_text('{"seconds": 1.5, "commit": "commit abc"}')
    assert finished(folder) == (1.5, "commit abc")
    assert state_of(run, tmp_path).kind == "finished"


def test_other_settings_than_todays_are_noticed(tmp_path):
    run = Run(TINY[0], "estimate", 0)
    folder = run.folder(tmp_path)
    folder.mkdir(parents=True)
    (folder / DONE).write_text('{"seconds": 1.5, "commit": "commit abc"}')
    (folder / "config.toml").write_text(write_config(dataclasses.replace(run.config(), gamma=0.5, timesteps=9), {}))
    kind, text = state_of(run, tmp_path)
    assert kind == "other"
    assert f"{folder} was trained with other settings than today's" in text
    assert "timesteps = 9 and not 4000; gamma = 0.5 and not 0.8" in text


def test_learning_curves_of_costs_and_of_returns(tmp_path, monkeypatch):
    """Kinds have one colour in all panels, their own numbers of steps, and positive returns a linear axis."""
    from matplotlib.figure import Figure

    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    steps = np.array([1e6, 2e6])
    named = {f"kind {number}": (steps, -np.ones((3, 2)) * (number + 1)) for number in range(6)}
    longer = {"kind 5": (np.arange(5.0), np.arange(10.0).reshape(2, 5))}
    learning_curves({"costs": named, "returns": longer}, tmp_path / "curves.png")
    costs, returns = drawn[0].axes
    assert (costs.get_yscale(), returns.get_yscale()) == ("log", "linear")
    assert len(costs.lines) == 6
    assert returns.lines[0].get_color() == costs.lines[5].get_color()
    np.testing.assert_array_equal(returns.lines[0].get_ydata(), [2.5, 3.5, 4.5, 5.5, 6.5])
    np.testing.assert_array_equal(costs.lines[1].get_ydata(), [2.0, 2.0])


def test_the_command_is_interrupted_and_continued(tmp_path, monkeypatch, capsys):
    """Trainings, measurements, the page: nothing is done twice, and what was written by hand stays."""
    docs, root = tmp_path / "docs", tmp_path / "runs"
    page = docs / "benchmarks" / "learning.md"
    page.parent.mkdir(parents=True)
    page.write_text(f"old\n\n{publish_table.BY_HAND}\n\n## By hand\n")
    command = ["--root", str(root), "--docs", str(docs), "--workers", "1", "--episodes", "3", "--seeds", "1"]
    trained, played, train, play = [], [], training.train, study_measured._play

    def interrupted(config, out, **arguments):
        """The second training gets a Ctrl-C, as long as there is no third."""
        trained.append((out.name, arguments["resume"]))
        ctrl_c = (lambda *_: signal.raise_signal(signal.SIGINT)) if len(trained) == 2 else None
        return train(config, out, on_progress=ctrl_c, **arguments)

    monkeypatch.setattr(training, "train", interrupted)
    monkeypatch.setattr(study_measured, "_play", lambda job: (played.append(job), play(job))[1])
    assert publish_table.main([*command, "--hours", "0"], TINY) == 0
    assert "4 of 4 trainings weren't begun" in capsys.readouterr().out
    assert "**20 of 20 trainings are missing**" in page.read_text()
    assert len(played) == 2 * (3 + 3) * len(SCRIPTS) + 2 * 3  # modes and networks; floors
    first = page.read_text()
    assert first.endswith(f"\n{publish_table.BY_HAND}\n\n## By hand\n")
    assert trained == []
    played.clear()

    assert publish_table.main(command, TINY) == 130
    assert "interrupted: finished trainings and measurements are kept" in capsys.readouterr().out
    assert (trained, played, page.read_text()) == ([("estimate-0", False), ("oracle-0", False)], [], first)
    assert publish_table.main(command, TINY) == 0
    assert trained[2:] == [("oracle-0", True), ("estimate-0", False), ("ideal-0", False)]
    assert len(played) == 1 + 2 + 1 + 3  # of the networks as well
    text = page.read_text()
    assert "**16 of 20 trainings are missing**" in text
    assert text.count("| 1/5 | -") == 7
    assert "THE GUARANTEE" not in text
    assert all((docs / "images" / name).exists() for name in ("learning.png", "learning_networks.png"))

    played.clear()
    next((root / "measured").glob("*.npz")).write_bytes(b"half")
    assert publish_table.main([*command, "--only", "convoy", "--trainings", "estimate"], TINY) == 0
    assert (len(trained), len(played)) == (5, 1)
    assert page.read_text().partition("## What")[2] == text.partition("## What")[2]

    policy = Run(TINY[1], "estimate", 0).folder(root) / "best.npz"
    whole = policy.read_bytes()
    policy.write_bytes(b"half")
    assert publish_table.main([*command, "--hours", "0"], TINY) == 1
    assert f"ppo:{policy.parent} on leader_following_v0 on convoy: can't be played" in capsys.readouterr().out
    assert page.read_text().count("| 1/5 | -") == 6
    policy.write_bytes(whole)

    longer = dataclasses.replace(TINY[1], timesteps=5000)
    assert publish_table.main([*command, "--hours", "0"], (TINY[0], longer)) == 1
    assert "timesteps = 4000 and not 5000" in capsys.readouterr().out
    assert "**17 of 20 trainings are missing**; 1 have other settings than today's" in page.read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "convoi"], "no 'convoi' in the study; did you mean 'convoy'"),
        (["--trainings", "estimate,lossi"], "no 'lossi' in the study; did you mean 'lossy'"),
        (["--hours", "-1"], "--hours must be at least 0; got -1"),
        (["--workers", "0"], "--workers must be at least 1; got 0"),
    ],
)
def test_wrong_options(options, message, capsys):
    with pytest.raises(SystemExit):
        publish_table.main(options)
    assert message in capsys.readouterr().err
