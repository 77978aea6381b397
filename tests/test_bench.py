"""The benchmark's yardsticks do the same work as the simulator, and the benchmark runs."""

import numpy as np

from agents import make_law
from khop_env.bench import benchmark, environments
from khop_env.bench.yardsticks import CompiledPaper
from khop_env.observers import Explicit
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
        "speedup_vs_scipy_batch",
        "ratio_to_floor",
        "growth_time",
        "growth_memory",
        "training",
        "training_environment_share",
    } <= set(rows)
    assert PARTS | RATES | {"environment_control_period", "environment_substeps"} <= set(rows)
    assert (rows["environment_control_period"], rows["environment_substeps"]) == (0.05, 1)
    assert all(np.isfinite(value) and value > 0 for value in rows.values())
    assert rows["proximal_error"] < 2e-3
    assert lines


def test_ratios_to_peers(tmp_path, monkeypatch):
    """To those that are installed: ours over theirs, and what is compared stands beside it."""
    asked = []

    def peer_rate(python, peer, batch, threads, seconds):
        asked.append((python, peer, batch, threads))
        return 100.0

    monkeypatch.setattr(environments, "_peer_rate", peer_rate)
    for peer in ("mpe2", "jaxmarl"):  # and no VMAS
        (tmp_path / peer / "bin").mkdir(parents=True)
        (tmp_path / peer / "bin" / "python").touch()
    rows = {}

    def add(name, value, unit="x", target=""):
        rows[name] = value, unit, target

    environments.environment_rows(add, True, print, tmp_path)
    ratios = {name for name in rows if name.endswith("_ratio")}
    assert ratios == {f"{name}_ratio" for name in RATES if name.startswith("single") or name.endswith("jax")}
    for name in ratios:
        assert rows[name][0] == rows[name.removesuffix("_ratio")][0] / 100.0
    assert rows["vector_convoy_jax_ratio"][1:] == (
        "x JaxMARL simple_spread, batch 64, a step a call: our one thread against XLA's own pool",
        "aim 1",
    )
    assert asked[0] == (tmp_path / "mpe2" / "bin" / "python", "mpe2", 1, 1)
