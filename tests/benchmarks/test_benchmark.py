"""The benchmark's yardsticks do the same work as the simulator, and the benchmark runs."""

import importlib.util
import json
import signal
import subprocess
import sys

import numpy as np
import pytest

from agents import make_law
from benchmarks import benchmark as module
from benchmarks import environments
from benchmarks.benchmark import benchmark
from benchmarks.comparison import compare, left_out
from benchmarks.growth import held_memory
from benchmarks.precision import RightHandSide, cubic
from benchmarks.report import Report
from benchmarks.yardsticks import CompiledPaper
from khop_env.observers import Explicit, Proximal
from khop_env.registry import scenario as scenario_of
from khop_env.scenarios import paper


def test_compiled_explicit_loop_equals_the_explicit_integrator():
    scenario = paper()
    simulator = scenario.build(law=make_law(scenario.law), observers=Explicit(), num_envs=3)
    loop = CompiledPaper(simulator)
    for _ in range(200):
        simulator.step(1e-5)
    loop.run(1e-5, 200)
    state = simulator.save()
    for ours, theirs in zip(loop.z, (state.x, state.memory["estimate"], state.memory["input_estimate"]), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-12)


PARTS = {
    f"{kind}_{scenario}: {part}"
    for kind in ("single", "vector")
    for scenario in ("paper", "convoy")
    for part in ("solve", "right-hand sides", "observation", "rest, Python and NumPy")
}
VMAS = ("order1", "order2", "threads2")
RATES = {f"single_order{order}" for order in (1, 2)} | {
    f"vector_{scenario}_{what}" for scenario in ("paper", "convoy") for what in ("order1", "order2", "threads2", "jax")
}


def test_every_promised_figure_is_printed():
    lines = []
    report = benchmark(quick=True, progress=lines.append)
    rows = {row["name"]: row["value"] for row in report["rows"]}
    assert {
        "proximal_error",
        "speedup_vs_explicit",
        "explicit_to_floor",
        "speedup_vs_explicit_single",
        "speedup_vs_scipy",
        "speedup_vs_scipy_fixed",
        "speedup_vs_scipy_batch",
        "speedup_vs_scipy_mixed_fleet",
        "ratio_to_floor",
        "growth_time",
        "growth_memory",
        "environment_growth_time",
        "environment_growth_memory",
        "wifi_growth_time",
        "wifi_growth_memory",
        "training",
        "training_environment_share",
        "training_jax",
        "network_relay_ratio",
        "network_ppso_ratio",
        "continuous_memory",
        "relay_memory",
        "ppso_memory",
        "error_to_certified_bound",
    } <= set(rows)
    if importlib.util.find_spec("jax") is None:
        assert rows.pop("training_jax") is None
    assert rows.pop("violations") == rows.pop("collisions_certified") == 0
    assert {f"filter_{place}_{how}" for place in ("apart", "crowd") for how in ("single", "batch")} <= set(rows)
    threads = {"threads_paper", "threads_convoy", "threads_paper_wifi"}
    assert threads | {f"{name}_plain" for name in threads} <= set(rows)
    assert PARTS | RATES | {"environment_control_period", "environment_substeps"} <= set(rows)
    assert {f"{kind}_making_1000" for kind in ("environment", "wifi")} <= set(rows)
    assert (rows["environment_control_period"], rows["environment_substeps"]) == (0.05, 1)
    assert all(np.isfinite(value) and value > 0 for value in rows.values())
    assert rows["proximal_error"] < 2e-3
    assert lines
    assert all(row["explanation"] for row in report["rows"])


def test_rows_say_whether_they_keep_their_target():
    report = Report()
    for name, value, bounds in (
        ("training", 3.0, {"least": 3.0}),
        ("training", 2.9, {"least": 3.0}),
        ("violations", 1.0, {"most": 0.0}),
        ("violations", 0.0, {"most": 0.0}),
        ("training", 1.0, {}),
    ):
        report.add(name, value, **bounds)
    assert [(row["target"], row["met"]) for row in report.rows] == [
        ("at least 3", True),
        ("at least 3", False),
        ("at most 0", False),
        ("at most 0", True),
        ("", None),
    ]


def test_parts_by_name(quick_parts):
    assert [row["name"] for row in benchmark(quick=True, only=["growth", "explicit"])["rows"]] == ["row 0", "row 1"]
    with pytest.raises(ValueError, match="unknown part 'speed' of the benchmark; the parts are explicit, scipy, solve"):
        benchmark(only=["growth", "speed"])


def test_ratios_to_peers(tmp_path, monkeypatch):
    """To installed peers: our rate over the peer's, with the compared cases in the row."""
    asked = []

    def peer_rate(python, peer, batch, threads, seconds):
        asked.append((python, peer, batch, threads))
        return 100.0

    monkeypatch.setattr(environments, "_peer_rate", peer_rate)
    for peer in ("mpe2", "jaxmarl"):  # and no VMAS
        (tmp_path / peer / "bin").mkdir(parents=True)
        (tmp_path / peer / "bin" / "python").touch()
    report = Report()
    environments.environment_rows(report, True, print, tmp_path)
    skipped = {row["name"]: row["skipped"] for row in report.rows if row["skipped"] is not None}
    assert set(skipped) == {f"vector_{scenario}_{what}_ratio" for scenario in ("paper", "convoy") for what in VMAS}
    assert set(skipped.values()) == {f"no {tmp_path / 'vmas' / 'bin' / 'python'}: `make bench PEERS=1` installs it"}
    rows = {
        row["name"]: (row["value"], row["unit"], row["target"]) for row in report.rows if row["name"] not in skipped
    }
    ratios = {name for name in rows if name.endswith("_ratio")}
    assert ratios == {f"{name}_ratio" for name in RATES if name.startswith("single") or name.endswith("jax")}
    for name in ratios:
        assert rows[name][0] == rows[name.removesuffix("_ratio")][0] / 100.0
    assert rows["vector_convoy_jax_ratio"][1:] == (
        "x JaxMARL simple_spread, batch 64, a step a call: our one thread against XLA's own pool",
        "at least 1",
    )
    assert asked[0] == (tmp_path / "mpe2" / "bin" / "python", "mpe2", 1, 1)


def test_the_report_says_which_peers_are_missing(tmp_path):
    assert left_out(None) == []
    with pytest.raises(ValueError, match=r"--peers .*: expected virtual environments named mpe2, vmas, jaxmarl in it"):
        left_out(tmp_path)
    (tmp_path / "vmas" / "bin").mkdir(parents=True)
    (tmp_path / "vmas" / "bin" / "python").touch()
    assert [line.split(" (")[0] for line in left_out(tmp_path)] == ["ratios to mpe2", "ratios to jaxmarl"]


def test_a_peer_that_fails_costs_its_ratio_only(tmp_path):
    (tmp_path / "mpe2" / "bin").mkdir(parents=True)
    (tmp_path / "mpe2" / "bin" / "python").touch()
    asked = []

    def theirs(python):
        asked.append(python)
        raise subprocess.CalledProcessError(1, "python", stderr="Traceback\nImportError: no mpe2\n")

    report = Report()
    compare(report, "rate", "1/s", lambda: 3.0, theirs, (tmp_path, "mpe2"), ("x", ""), 5)
    assert [(row["name"], row["value"], row["skipped"]) for row in report.rows] == [
        ("rate", 3.0, None),
        ("rate_ratio", None, "mpe2 failed: ImportError: no mpe2"),
    ]
    assert len(asked) == 1


@pytest.fixture
def quick_parts(monkeypatch):
    """Parts that need the core only, with a row each."""
    for index, name in enumerate(("_against_explicit", "growth_rows")):
        monkeypatch.setattr(module, name, lambda add, *rest, index=index: add(f"row {index}", 1.0))
    monkeypatch.setattr(module, "_ratio_to_floor", lambda quick: 2.0)
    monkeypatch.setattr(module, "environment_rows", lambda report, *rest: report.add("row 2", np.inf))
    monkeypatch.setattr(module, "network_rows", lambda report, *rest: report.add("row 3", 1.0))
    monkeypatch.setattr(module, "violation_rows", lambda report, *rest: report.add("row 4", 0.0))
    for name in ("speed_rows", "collision_rows"):
        monkeypatch.setattr(module, name, lambda report, *rest: None)


class NotInstalled:
    """Packages that can't be imported."""

    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("scipy", "stable_baselines3", "torch"):
            raise ModuleNotFoundError(f"No module named {name!r}")


def test_without_the_extras_the_rest_is_measured(quick_parts, monkeypatch):
    for name in ("scipy", "stable_baselines3", "torch"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setattr(sys, "meta_path", [NotInstalled(), *sys.meta_path])
    lines = []
    report = benchmark(quick=True, progress=lines.append)
    how = "in a clone of khop_env, pip install -c constraints.txt -e '.[bench]'"
    assert lines[:3] == [
        f"left out: steps of controlled size against SciPy's LSODA (needs scipy: {how})",
        f"left out: training: PPO, 64 environments of 8 agents (needs stable_baselines3 and torch: {how})",
        "proximal against explicit, closed loop of `paper`",
    ]
    assert [(row["name"], row["value"], row["skipped"]) for row in report["rows"]] == [
        ("row 0", 1.0, None),
        ("speedup_vs_scipy", None, f"needs scipy: {how}"),
        ("speedup_vs_scipy_fixed", None, f"needs scipy: {how}"),
        ("speedup_vs_scipy_batch", None, f"needs scipy: {how}"),
        ("speedup_vs_scipy_mixed_fleet", None, f"needs scipy: {how}"),
        ("ratio_to_floor", 2.0, None),
        ("row 1", 1.0, None),
        ("row 2", None, "came out as inf"),
        ("row 3", 1.0, None),
        ("row 4", 0.0, None),
        ("training", None, f"needs stable_baselines3 and torch: {how}"),
        ("training_environment_share", None, f"needs stable_baselines3 and torch: {how}"),
    ]
    assert (report["failed"], report["interrupted"]) == ([], False)
    json.dumps(report, allow_nan=False)


@pytest.mark.parametrize("error", [RuntimeError("broken"), KeyboardInterrupt()], ids=["an error", "Ctrl-C"])
def test_what_was_measured_is_not_lost(quick_parts, monkeypatch, error):
    def broken(*arguments):
        raise error

    monkeypatch.setattr(module, "scipy_rows", broken)
    monkeypatch.setattr(module, "training_rows", broken)
    report = benchmark(quick=True)
    if isinstance(error, KeyboardInterrupt):
        assert [row["name"] for row in report["rows"]] == ["row 0"]
        assert (report["failed"], report["interrupted"]) == ([], True)
    else:
        assert len(report["rows"]) == 8
        assert report["rows"][1]["skipped"] == "failed: RuntimeError: broken"
        assert report["failed"] == [
            "steps of controlled size against SciPy's LSODA",
            "training: PPO, 64 environments of 8 agents",
        ]
        assert not report["interrupted"]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for a child there")
def test_ctrl_c_ends_the_command_with_a_table():
    command = [sys.executable, "-m", "khop_env", "bench", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert "this takes about" in process.stderr.readline()
    assert process.stderr.readline().startswith("proximal against explicit")
    process.send_signal(signal.SIGINT)
    output, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert json.loads(output)["interrupted"] is True
    assert "interrupted" in said
    assert "Traceback" not in said


def test_memory_counts_arrays_and_objects_once_and_leaves_out_what_is_shared():
    shared, own = np.zeros(10_000), np.zeros(20_000)
    subject = {"own": own, "view": own[5:], "again": [own], "shared": shared[1:]}
    held = held_memory([subject], besides=[shared])
    assert own.nbytes < held < own.nbytes + 3000
    assert own.nbytes + shared.nbytes < held_memory([subject], besides=[])


def test_the_right_hand_side_for_scipy_is_the_simulators():
    """A short explicit step by it is the explicit integrator's, of states and both kinds of estimates."""
    for name in ("paper", "mixed_fleet"):
        chosen = scenario_of(name)
        simulator = chosen.build(law=make_law(chosen.law), observers=Proximal(2)).reset(1)
        for _ in range(30):
            simulator.step(0.01)
        equations, t = RightHandSide(simulator), float(simulator.t[0])
        explicit = chosen.build(law=make_law(chosen.law), observers=Explicit())
        explicit.restore(simulator.save())
        explicit.step(1e-6)
        after = np.concatenate([explicit.x[0], explicit.estimates[0], explicit.input_estimates[0]])
        np.testing.assert_allclose(
            equations.start + 1e-6 * equations(t, equations.start), after, rtol=1e-11, atol=1e-13
        )


def test_dense_values_of_fixed_steps_are_cubic():
    """Exact for polynomials of degree 3, at both ends as well."""
    times, grid = np.linspace(0.0, 1.0, 41), np.linspace(0.0, 1.0, 11)
    values = np.stack([grid**3 - grid, 2.0 - grid**2], axis=1)
    np.testing.assert_allclose(
        cubic(0.1, values, times), np.stack([times**3 - times, 2.0 - times**2], axis=1), atol=1e-14
    )
