"""The benchmark's yardsticks do the same work as the simulator, and the benchmark runs."""

import numpy as np

from agents import make_law
from khop_env.bench import benchmark
from khop_env.bench.yardsticks import CompiledPaper
from khop_env.scenarios import paper
from khop_env.simulation import Explicit


def test_compiled_explicit_loop_equals_the_explicit_integrator():
    scenario = paper()
    simulator = scenario.build(law=make_law(scenario.law), integrator=Explicit(), batch=3)
    loop = CompiledPaper(simulator)
    for _ in range(200):
        simulator.step(1e-5)
    loop.run(1e-5, 200)
    state = simulator.save()
    for ours, theirs in zip(loop.z, (state.x, state.estimate, state.input_estimate), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-12)


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
    } <= set(rows)
    assert all(np.isfinite(value) and value > 0 for value in rows.values())
    assert rows["proximal_error"] < 2e-3
    assert lines
