import itertools
import json
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import polars as pl
import pytest
from typer.testing import CliRunner

import khop_env
from benchmarks.report import Report
from khop_env import __version__
from khop_env.catalog import ENVIRONMENTS
from khop_env.cli import COMMANDS, app
from khop_env.registry import SCENARIOS


def khop(*arguments: str, status: int = 0):
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == status, (result.stdout, result.stderr, result.exception)
    return result


def only_json(result):
    """Stdout is one JSON object and nothing else."""
    value = json.loads(result.stdout)
    assert isinstance(value, dict)
    return value


def refused(*arguments: str) -> str:
    """The one paragraph on stderr, with nothing on stdout."""
    result = khop(*arguments, status=2)
    assert result.stdout == ""
    lines = [line for line in result.stderr.splitlines() if not line.startswith("khop_env: compiling")]
    assert len(lines) == 1
    assert lines[0].startswith("khop: ")
    return lines[0]


FILES = ("estimates: ", "states: ", "summary: ", "figure: ", "injected: ", "swept: ")  # lines with a path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


class TestList:
    def test_table(self):
        found = khop("list").stdout
        for name in ("paper", "mixed_fleet", "random_geometric", "agents=100", "leader_following_v0"):
            assert name in found
        assert re.search(r"leader_following_convoy_lossy +convoy +lossy:loss=0.3,burst=5", found)

    def test_json(self):
        found = only_json(khop("list", "--json"))
        assert [each["name"] for each in found["scenarios"]] == list(SCENARIOS)
        assert found["environments"] == list(ENVIRONMENTS)
        assert {
            "name": "consensus_paper",
            "environment": "consensus_v0",
            "scenario": "paper",
            "network": None,
        } in found["policies"]

    def test_card(self):
        found = khop("list", "--card", "leader_following_convoy").stdout
        assert found.startswith("## `leader_following_convoy`\n")
        assert "**Fails.**" in found
        assert found.count("\n## ") == 0
        assert "no pretrained policy 'convoy'; there are consensus_paper, " in refused("list", "--card", "convoy")


LONG = "linear:gain=2,cancel_drift=true"


@pytest.mark.parametrize(
    "arguments",
    [
        ["list"],
        ["check", "paper"],
        ["check", "mixed_fleet"],
        ["check", "random_geometric:agents=60,k=4"],
        ["run", "mixed_fleet", "--duration", "0.05"],
        ["run", "consensus_v0", "--controller", "zero", "--duration", "0.1"],
        ["iss", "paper", "--episodes", "1", "--duration", "0.5"],
        ["evaluate", "leader_following_v0", "--policies", f"{LONG},ppo:pretrained", "--episodes", "2"],
    ],
    ids=" ".join,
)
def test_tables_fit_80_columns_and_break_between_words(arguments, folder):
    found = khop(*arguments).stdout
    lines = [line.rstrip() for line in found.splitlines() if not line.startswith(FILES)]
    assert max(len(line) for line in lines) <= 80
    if arguments[0] == "evaluate":
        assert {"linear:gain=2,", "cancel_drift=true", "ppo:pretrained", "oracle"} <= set(found.split())
        assert found.count("±") == 11  # six returns, five differences
        assert any(line.rstrip().endswith("bound") for line in found.partition("──")[0].splitlines())  # the last column
    if arguments[0] == "check":
        words = set(found.split())
        report = only_json(khop(*arguments, "--json"))
        for one in report["assumptions"]:
            assert set(one["why"].split()) <= words, one
        for target in report["targets"][:20]:
            assert target["agent"] in words


class TestCheck:
    def test_table(self):
        found = khop("check", "paper").stdout
        for part in ("drifter_3", "0.382 .. 2.618", "2.405 -> 0.01999", "holds by construction", "feasible: every"):
            assert part in found
        assert "3.29e-05 s (state observers)" in found

    def test_json(self):
        result = khop("check", "paper", "--json")
        assert only_json(result)["feasible"] is True

    def test_a_large_fleet_is_cut_short(self):
        found = khop("check", "random_geometric:agents=60").stdout
        assert "and 40 more (--json has all). Over all 60: eta" in " ".join(found.split())
        report = only_json(khop("check", "random_geometric:agents=60", "--json"))
        assert len(report["targets"]) == 60

    @pytest.mark.parametrize("options", [[], ["--json"]])
    def test_infeasible(self, folder, options):
        text = khop("export", "paper").stdout.replace("initial_radius = 1.5", "initial_radius = 5.0")
        (folder / "wide.toml").write_text(text)
        result = khop("check", "wide.toml", *options, status=1)
        assert "take delta(0) above" in result.stdout
        if options:
            assert only_json(result)["feasible"] is False

    def test_a_design_that_is_impossible(self, folder):
        text = khop("export", "paper").stdout
        start, stop = text.index("[theta]"), text.index("# Disturbances")
        (folder / "bare.toml").write_text(text[:start] + text[stop:])
        assert "not feasible: bare.toml: theta is missing" in khop("check", "bare.toml", status=1).stdout
        assert only_json(khop("check", "bare.toml", "--json", status=1))["error"].startswith("bare.toml: theta")
        said = refused("run", "bare.toml")
        assert said.startswith("khop: bare.toml: theta is missing")
        assert said.endswith("set input_observer = false")  # as one writes it in a file

    @pytest.mark.usefixtures("without_figures")
    def test_unlimited_inputs_are_left_to_the_start_as_a_run_does(self, folder):
        text = khop("export", "paper").stdout
        (folder / "free.toml").write_text(re.sub(r"input_limit = .*", "input_limit = inf", text))
        found = khop("check", "free.toml").stdout
        assert "inf" not in found.replace("feasible", "").replace("infinity", "").replace("inf)", "")
        assert "at reset" in found
        assert "a run checks at its start that inputs begin inside" in " ".join(found.split())
        assert only_json(khop("run", "free.toml", "--duration", "0.05", "--json"))["funnel_kept"] is True


class TestRun:
    def test_everything_is_written(self, folder):
        result = khop("run", "paper", "--duration", "0.5", "--seed", "3")
        out = folder / "runs" / "paper-tanh-estimate-seed3"
        assert sorted(path.name for path in out.iterdir()) == [
            "estimates.parquet",
            "figure.png",
            "states.parquet",
            "summary.json",
        ]
        summary = json.loads((out / "summary.json").read_text())
        assert summary["seed"] == 3
        assert summary["duration"] == 0.5
        assert (summary["dt"], summary["integrator"], summary["order"]) == (0.01, "proximal", 2)
        assert summary["funnel_kept"] is True
        assert "guarantee kept" in result.stdout
        assert f"{summary['max_normalized_disagreement']:.3f}" in result.stdout
        assert f"{summary['max_error_to_bound_input']:.3f}" in result.stdout
        assert "figure: runs/paper-tanh-estimate-seed3/figure.png" in result.stdout
        estimates = pl.read_parquet(out / "estimates.parquet")
        assert estimates["time"].n_unique() == 51
        assert (estimates["error"] - (estimates["estimate"] - estimates["state"])).abs().max() == 0.0
        assert (estimates["disagreement"].abs() / estimates["rho"]).max() < 1.0
        assert pl.read_parquet(out / "states.parquet").columns == ["time", "agent", "component", "x", "u"]
        assert (out / "figure.png").stat().st_size > 20_000

    def test_json(self, folder):
        result = khop("run", "paper", "--duration", "0.1", "--json", "--out", "here")
        found = only_json(result)
        files = found.pop("files")
        assert found == json.loads((folder / "here" / "summary.json").read_text())
        assert files["figure"] == "here/figure.png"

    @pytest.mark.usefixtures("without_figures")
    def test_same_seed_same_bits(self, folder):
        for out, seed in (("a", "1"), ("b", "1"), ("c", "2")):
            khop("run", "mixed_fleet", "--duration", "0.1", "--seed", seed, "--out", out)
        a, b, c = (pl.read_parquet(f"{out}/estimates.parquet") for out in "abc")
        assert a.equals(b)
        assert not a.equals(c)

    @pytest.mark.usefixtures("without_figures")
    def test_options(self, folder):
        options = [
            "--controller",
            "tanh",
            "--observe",
            "local",
            "--dt",
            "0.05",
            "--order",
            "1",
            "--integrator",
            "proximal",
        ]
        found = only_json(khop("run", "paper", "--duration", "0.2", *options, "--json"))
        assert (found["observe"], found["dt"], found["order"], found["steps"]) == ("local", 0.05, 1, 4)
        assert found["controller"] == "tanh"

    @pytest.mark.usefixtures("without_figures")
    def test_observe_changes_what_the_law_sees(self, folder):
        errors = {
            observe: only_json(khop("run", "paper", "--duration", "1", "--observe", observe, "--json"))[
                "final_consensus_error"
            ]
            for observe in ("estimate", "oracle", "local")
        }
        assert len(set(errors.values())) == 3
        assert errors["local"] > errors["oracle"]

    @pytest.mark.usefixtures("without_figures")
    def test_explicit_steps_as_the_paper_samples(self, folder):
        found = only_json(khop("run", "paper", "--integrator", "explicit", "--duration", "0.002", "--json"))
        assert (found["integrator"], found["order"], found["dt"], found["steps"]) == ("explicit", 1, 1e-5, 200)

    @pytest.mark.usefixtures("without_figures")
    def test_steps_of_controlled_size(self, folder):
        found = only_json(khop("run", "paper", "--tolerance", "1e-2", "--duration", "1", "--json"))
        assert (found["dt"], found["tolerance"], found["samples"]) == (None, 1e-2, 101)
        assert (found["order"], found["steps"] < 60) == (3, True)
        assert found["funnel_kept"] is True
        assert found["configuration"]["tolerance"] == 1e-2
        for options, expected in (
            (["--dt", "0.01"], "--dt: the size of steps follows from --tolerance"),
            (["--order", "1"], "--order 1: --tolerance is for the proximal step of order 2 or 3"),
            (["--integrator", "explicit"], "--integrator explicit: --tolerance is for"),
            (["--network", "wifi"], "--tolerance: over a network estimates follow from rounds of messages"),
            (["--controller", "random"], "--tolerance: a policy acts in its environment"),
        ):
            assert expected in khop("run", "paper", "--tolerance", "1e-2", *options, status=2).stderr
        assert "from 1e-09 to 1; got 3.0" in khop("run", "paper", "--tolerance", "3", status=2).stderr

    def test_leaving_the_funnel_loses_nothing(self, folder):
        arguments = ["run", "paper", "--integrator", "explicit", "--dt", "1e-3", "--out", "lost"]
        result = khop(*arguments, status=1)
        assert "the explicit step left the funnel" in result.stderr
        assert "would have been stable" in result.stderr
        assert "guarantee not kept: stopped at t = 0." in result.stdout
        assert len(list((folder / "lost").iterdir())) == 4
        assert pl.read_parquet("lost/estimates.parquet")["time"].max() > 0.1
        found = only_json(khop(*arguments, "--json", status=1))
        assert found["funnel_kept"] is False
        assert "left the funnel" in found["error"]

    def test_a_plant_that_diverges_loses_nothing(self, folder):
        """Points without limits under a gain far too high for their steps: the states overflow, and it says so."""
        lines = 'name = "points"\nk = 2\n[[agents]]\nmodel = "integrator"\ncount = 4\ninput_limit = inf\n'
        edges = f"edges = {[list(edge) for edge in itertools.combinations(range(4), 2)]}\n"
        bound = "initial = 10\nfinal = 1\nrate = 5\n"
        law = '[law]\nname = "linear"\ngain = 100\n'
        (folder / "points.toml").write_text(
            f"{lines}[communication]\n{edges}[task]\n{edges}[delta]\n{bound}[theta]\n{bound}{law}"
        )
        arguments = ["run", "points.toml", "--dt", "3", "--duration", "360"]
        result = khop(*arguments, status=1)
        assert "the plant diverged" in result.stdout
        assert "Warning" not in result.stderr
        assert len(list((folder / "runs" / "points-linear-estimate-seed0").iterdir())) == 4
        found = only_json(khop(*arguments, "--json", status=1))
        assert found["funnel_kept"] is False
        assert found["diverged"] is True

    @pytest.mark.parametrize("film", ["film.mp4", "new/film.gif"])
    @pytest.mark.usefixtures("without_figures")
    def test_a_film_is_one_more_file(self, folder, film):
        options = ["--duration", "0.1", "--out", "out", "--video", film]
        result = khop("run", "paper", *options, "--observer", "drifter_5")
        assert f"video: {film}\n" in result.stdout
        assert (folder / film).stat().st_size > 5000
        assert len(list((folder / "out").iterdir())) == 4
        assert only_json(khop("run", "paper", *options, "--observer", "5", "--json"))["files"]["video"] == film

    def test_a_film_that_cannot_be_written_loses_nothing_else(self, folder):
        (folder / "film.gif").mkdir()
        result = khop("run", "paper", "--duration", "0.1", "--out", "out", "--video", "film.gif", status=2)
        assert "summary: out/summary.json" in result.stdout
        assert "video:" not in result.stdout
        assert "khop: couldn't write film.gif (" in result.stderr
        assert len(list((folder / "out").iterdir())) == 4

    def test_films_that_could_not_be_made_are_refused_before_anything_is_computed(self, folder, monkeypatch):
        assert "must end in .mp4 or .gif" in refused("run", "paper", "--video", "film.avi")
        assert "did you mean 'drifter_" in refused("run", "paper", "--video", "film.gif", "--observer", "driftr_1")
        assert "no agent 8" in refused("run", "paper", "--video", "film.gif", "--observer", "8")
        assert "give --video FILE, too" in refused("run", "paper", "--observer", "1")
        monkeypatch.setitem(sys.modules, "pygame", None)
        assert "pip install -c constraints.txt -e '.[render]'" in refused("run", "paper", "--video", "film.gif")
        assert not list(folder.iterdir())

    def test_a_file_that_cannot_be_written_is_told_after_the_summary(self, folder):
        (folder / "out" / "figure.png").mkdir(parents=True)
        result = khop("run", "paper", "--duration", "0.05", "--out", "out", status=2)
        assert "guarantee kept" in result.stdout
        assert "summary: out/summary.json" in result.stdout
        assert "khop: couldn't write out/figure.png" in result.stderr

    @pytest.mark.parametrize(("name", "expected"), [("..", "scenario"), ("a: b", "a_b"), (".hidden", "hidden")])
    @pytest.mark.usefixtures("without_figures")
    def test_the_folder_stays_within_runs(self, folder, name, expected):
        (folder / "mine.toml").write_text(khop("export", "paper").stdout.replace('name = "paper"', f'name = "{name}"'))
        khop("run", "mine.toml", "--duration", "0.02")
        assert [path.name for path in folder.iterdir() if path.is_dir()] == ["runs"]
        assert [path.name for path in (folder / "runs").iterdir()] == [f"{expected}-tanh-estimate-seed0"]

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that Linux has")
    def test_stdout_that_is_full_is_one_line(self, folder):
        environment = {**os.environ, "PYTHONPATH": str(Path(khop_env.__file__).parents[1])}
        for arguments in (["list"], ["run", "paper", "--duration", "0.02"]):
            with open("/dev/full", "w") as full:
                done = subprocess.run(
                    [sys.executable, "-m", "khop_env", *arguments],
                    env=environment,
                    stdout=full,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            lines = [line for line in done.stderr.splitlines() if not line.startswith("khop_env: compiling")]
            assert done.returncode == 2
            assert len(lines) == 1
            assert "No space left" in lines[0]

    def test_refusals(self, folder):
        assert "no scenario 'papr'; did you mean 'paper'?" in refused("run", "papr")
        assert "no law or policy 'tan'; did you mean 'tanh'?" in refused("run", "paper", "--controller", "tan")
        assert "no law or policy 'zro'; did you mean 'zero'?" in refused("run", "paper", "--controller", "zro")
        said = refused("run", "consensus")
        assert said == "khop: no scenario or environment 'consensus'; did you mean 'consensus_v0'?"
        assert "khop: dt must be positive and finite; got 0.0" in refused("run", "paper", "--dt", "0")
        assert "khop: duration must be positive" in refused("run", "paper", "--duration", "-1")
        assert "dt must be from 1e-09 to 1e+09 s; got 1e-300" in refused("run", "paper", "--dt", "1e-300")
        assert "duration must be from" in refused("run", "paper", "--duration", "1e-12")
        assert "are 1e+12 steps, and 1e+08 are the most" in refused("run", "paper", "--duration", "1e6", "--dt", "1e-6")
        assert "agents must be at most 100000" in refused("check", "random_geometric:agents=99999999999999999999")
        assert "forward Euler" in refused("run", "paper", "--integrator", "explicit", "--order", "2")
        assert "can't be read" in refused("run", "nowhere.toml")
        (folder / "taken").write_text("a file")
        assert "taken" in refused("run", "paper", "--out", "taken")
        for option, value in (("--observe", "all"), ("--integrator", "rk4"), ("--order", "4"), ("--seed", "-1")):
            result = khop("run", "paper", option, value, status=2)
            assert result.stdout == ""
            assert "Traceback" not in result.stderr

    @pytest.mark.usefixtures("without_figures")
    def test_a_task_graph_that_falls_apart_is_told(self, folder):
        text = khop("export", "paper").stdout
        start = text.index("[task]\nedges = [")
        stop = text.index("]\n\n", start)
        (folder / "apart.toml").write_text(text[:start] + "[task]\nedges = [[0, 1], [2, 3]" + text[stop:])
        warning = "the task graph falls into 6 parts, which agree among themselves only: drifter_0, drifter_1; "
        assert f"khop: {warning}" in khop("run", "apart.toml", "--duration", "0.05").stderr
        assert f"warning: {warning}" in " ".join(khop("check", "apart.toml").stdout.split()) + " "


class TestExport:
    @pytest.mark.usefixtures("without_figures")
    def test_a_file_to_start_from(self, folder):
        (folder / "mine.toml").write_text(khop("export", "paper").stdout)
        ours = only_json(khop("run", "paper", "--duration", "0.2", "--json", "--out", "a"))
        theirs = only_json(khop("run", "mine.toml", "--duration", "0.2", "--json", "--out", "b"))
        assert ours["max_normalized_disagreement"] == theirs["max_normalized_disagreement"]
        assert pl.read_parquet("a/estimates.parquet").equals(pl.read_parquet("b/estimates.parquet"))

    @pytest.mark.parametrize(
        ("old", "new", "said"),
        [
            (
                'name = "tanh"',
                'name = "tan"',
                "law.name: got 'tan', expected one of 'tanh', 'linear', 'formation', 'leader_following'; did you mean",
            ),
            (
                "gain = 2.0",
                "gian = 2.0",
                "mine.toml: law.gian: law 'tanh' has no parameter 'gian'; did you mean 'gain'?",
            ),
            ("gain = 2.0", 'gain = "high"', "mine.toml: law.gain: gain of law 'tanh' must be a number; got 'high'"),
            ("gain = 2.0", "gain = inf", "mine.toml: law: gain must be positive and finite"),
            ("gain = 2.0", "gain = -2.0", "mine.toml: law: gain must be positive"),
        ],
    )
    def test_a_law_that_is_wrong(self, folder, old, new, said):
        text = khop("export", "paper").stdout
        assert old in text
        (folder / "mine.toml").write_text(text.replace(old, new))
        assert said in refused("run", "mine.toml")


class TestBench:
    @pytest.fixture(autouse=True)
    def stand_in(self, monkeypatch):
        def benchmark(quick=False, progress=None, peers=None, only=None):
            progress("measuring")
            report = Report()
            report.add("training", 61.234567, "agent-steps/s", least=60.0)
            report.add("training_ratio", 2.5, least=3.0)
            for name in "ab":
                report.skip(name, "needs scipy")
            rows = [row for row in report.rows if only is None or row["name"] in only]
            return {"rows": rows, "machine": {"cores": 2}, "quick": quick, **self.ended}

        self.ended = {"failed": [], "interrupted": False}
        module = types.ModuleType("benchmarks.benchmark")
        module.benchmark = benchmark
        monkeypatch.setitem(sys.modules, "benchmarks.benchmark", module)

    def test_table(self):
        result = khop("bench")
        assert result.stderr == "measuring\n"
        lines = [" ".join(line.split()) for line in result.stdout.splitlines()]
        assert "training 61.23 agent-steps/s at least 60" in lines
        assert "training_ratio 2.5 x at least 3: MISSED" in lines
        assert "training: PPO, 64 environments of 8 agents, inside `learn`" in lines
        assert lines[-1] == "machine: cores 2"
        assert [line.split() for line in result.stdout.splitlines() if "skipped" in line] == [
            ["a", "skipped"],
            ["b", "skipped"],
            ["skipped:", "a,", "b:", "needs", "scipy"],
        ]

    def test_json(self):
        found = only_json(khop("bench", "--json", "--quick"))
        assert found["quick"] is True
        assert [row["skipped"] for row in found["rows"]] == [None, None, "needs scipy", "needs scipy"]
        assert [row["met"] for row in found["rows"]] == [True, False, None, None]

    def test_parts(self):
        found = only_json(khop("bench", "--json", "--only", "training, b"))
        assert [row["name"] for row in found["rows"]] == ["training", "b"]

    @pytest.mark.parametrize(
        ("ended", "status"),
        [({"failed": ["training"]}, 2), ({"interrupted": True}, 130)],
        ids=["failed", "interrupted"],
    )
    def test_what_was_measured_is_printed_however_it_ends(self, ended, status):
        self.ended |= ended
        assert "61.23" in khop("bench", status=status).stdout
        assert len(only_json(khop("bench", "--json", status=status))["rows"]) == 4

    def test_a_wheel_is_without_it(self, monkeypatch, tmp_path):
        monkeypatch.setattr("khop_env.commands.bench.REPOSITORY", tmp_path)
        assert refused("bench") == (
            "khop: benchmarks aren't installed, they are in khop_env's repository: run `make bench` in a clone of it"
        )


def test_version():
    assert khop("--version").stdout == f"{__version__}\n"


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_is_folded_between_words(command, monkeypatch):
    """Paragraphs fill their lines, and nothing is cut off with an ellipsis."""
    monkeypatch.setenv("COLUMNS", "80")
    found = khop(command, "--help").stdout
    assert max(map(len, found.splitlines())) <= 80
    assert "…" not in found
    paragraphs = " ".join(found.partition("╭")[0].split())
    assert " ".join(COMMANDS[command].__doc__.split()) in paragraphs


@pytest.mark.parametrize("command", [(), *((name,) for name in sorted(COMMANDS))])
def test_help_shows_flags_without_a_value(command):
    """As `--bounds true` isn't understood."""
    found = khop(*command, "--help").stdout
    assert "--help" in found
    assert "bool" not in found.lower()


def test_help_names_every_command():
    found = khop("--help").stdout
    for command in ("list", "check", "run", "export", "bench"):
        assert command in found


def test_as_a_module_in_a_process_of_its_own(tmp_path):
    command = [sys.executable, "-m", "khop_env", "run", "paper", "--duration", "0.1", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(Path(khop_env.__file__).parents[1])}
    found = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert json.loads(found.stdout)["funnel_kept"] is True
    assert (tmp_path / "runs" / "paper-tanh-estimate-seed0" / "figure.png").exists()


@pytest.mark.parametrize(
    ("command", "inside"),
    [
        (("run", "paper"), "khop_env.results.record"),
        (("check", "paper"), "khop_env.results.design_report"),
        (("test", "consensus_v0"), "khop_env.testing.check_environment"),
        (("evaluate", "consensus_v0"), "agents.comparison.compare"),
    ],
)
def test_status_after_ctrl_c_where_there_are_no_results(folder, monkeypatch, command, inside):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(inside, interrupt)
    khop(*command, status=130)
