"""Hypothesis for compiled code, and the quick selection.

Hypothesis: no deadline (the first example may compile), and the same examples on every machine.

`pytest -m quick` runs tests of every room in under a minute. Of a parametrised test it takes cases in which each pair
of parameter values occurs at least once (pairwise testing: D. M. Cohen, S. R. Dalal, M. L. Fredman and G. C. Patton,
The AETG system, IEEE Trans. Software Engineering 23(7), 1997), chosen greedily and so the same at every collection.
Left out is what `SLOW` lists.
"""

import itertools
import signal
from collections.abc import Hashable
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a job in a script's background ignores Ctrl-C, and so would its
    signal.signal(signal.SIGINT, signal.default_int_handler)  # children, which tests interrupt

PROFILE = {
    "deadline": None,
    "derandomize": True,
    "phases": (Phase.explicit, Phase.generate, Phase.target, Phase.shrink),
    "suppress_health_check": [HealthCheck.too_slow, HealthCheck.data_too_large],
}
settings.register_profile("reproducible", max_examples=100, **PROFILE)
settings.register_profile("quick", max_examples=10, **PROFILE)

SLOW = tuple(
    f"tests/{beginning}"
    for beginning in (
        # trainings
        "agents/test_callbacks.py",
        "agents/test_evaluation.py::test_a_model_of_stable_baselines_plays",
        "agents/test_initial.py",
        "agents/test_jax_ppo.py",
        "agents/test_learned_policies.py",
        "agents/test_learning.py",
        "agents/test_recurrent.py",
        "agents/test_residual.py",
        "agents/test_resuming.py",
        "agents/test_shielded.py::test_a_resumed_training",
        "agents/test_sweeps.py::test_a_sweep",
        "agents/test_sweeps.py::test_ctrl_c",
        "agents/test_sweeps.py::test_in_processes",
        "agents/test_sweeps.py::test_one_that_fails",
        "agents/test_sweeps.py::test_the_command",
        "agents/test_sweeps.py::test_what_a_callback",
        "agents/test_shielded.py::test_a_training_inside",
        "benchmarks/test_study.py::test_the_command",
        "env/test_integrations.py::TestSuperSuit::test_ppo",
        "env/test_sb3.py::test_ppo",
        # processes, one or more per test
        "agents/test_datasets.py::test_recording_changes_nothing",
        "agents/test_workers.py",
        "deploy/test_lockstep.py::test_processes",
        "deploy/test_policies.py::test_real_processes",
        "deploy/test_processes.py",
        "env/test_concurrency.py",
        "agents/test_evaluation.py::test_the_same_numbers",
        "benchmarks/test_benchmark.py::test_ctrl_c",
        "env/test_integrations.py::TestNames::test_import",
        "env/test_windows.py::test_without_a_display",
        "tasks/test_navigation.py::test_the_contract_is_kept",
        "observers/test_networked_threads.py::test_threads_and_batches_leave_every_bit",
        "observers/test_node.py::test_it_runs_without_numba",
        "results/test_figures.py::test_pyplot_is_left_alone",
        "test_cli.py::TestRun",
        "test_cli.py::test_as_a_module",
        "test_cli.py::test_tables_fit_80_columns",
        "test_cli_agents.py",
        "test_cli_contract.py",
        "test_cli_folders.py",
        "test_cli_network.py",
        "test_cli_objects.py",
        "test_cli_train.py",
        "test_compiled.py::test_a_change_in_another_file_is_seen",
        "test_compiled.py::test_no_byte_of_a_file",
        "test_core_only.py",
        "test_imports.py::test_the_core_needs_no_extra",
        "test_own_agents.py",
        "test_readme.py",
        "test_quick.py::test_every_room",
        "test_registry.py::test_heavy_imports_wait",
        "test_surface.py::test_a_user_s_file_is_clean",
        "test_surface.py::test_one_name_imports",
        "test_surface.py::test_scenarios_is_the_package",
        # many episodes, or many steps
        "agents/test_policy_files.py::test_a_zip_bomb",
        "agents/test_pretrained.py::TestChoice::test_comparisons",
        "agents/test_policy_files.py::test_every_mutation",
        "agents/test_scripted.py::test_every_law_makes_progress_everywhere",
        "agents/test_set_iss.py",
        "agents/test_tuning.py",
        "benchmarks/test_benchmark.py::test_every_promised_figure_is_printed",
        "benchmarks/test_counting_collisions.py",
        "benchmarks/test_side_by_side.py",
        "benchmarks/test_violations.py",
        "env/test_changing_links.py::test_the_public_checks_pass",
        "env/test_contract.py::test_the_public_checks_pass",
        "env/test_contract.py::test_300_steps",
        "env/test_networked_environments.py::test_the_public_checks_pass",
        "observers/test_changing_graphs.py",
        "observers/test_funnel_kept.py",
        "observers/test_theorems.py",
        "results/test_report.py::TestFloatingPoint",
        "results/test_writing.py::test_states_that_are_not_finite",
        "scenarios/test_fuzz.py",
        "tasks/test_own_task.py::test_every_kind",
        "tasks/test_own_task.py::test_it_keeps_the_contract",
        "testing/test_checking.py::test_each_fault",
        "testing/test_checking.py::test_each_view",
        "testing/test_checking.py::test_the_other_views",
    )
)
"""Beginnings of the ids of tests that aren't part of the quick selection, by what takes the time."""


def pytest_configure(config: pytest.Config) -> None:
    settings.load_profile("quick" if config.option.markexpr == "quick" else "reproducible")


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs write an empty figure.png; drawing takes nine tenths of a short run's time, and other tests look at it."""
    monkeypatch.setattr("khop_env.results.writing.paper_figure", lambda *drawn: drawn[2].write_bytes(b""))
    monkeypatch.setattr("khop_env.results.curves.set_iss_figure", lambda *drawn: drawn[2].write_bytes(b""))


@pytest.hookimpl(tryfirst=True)  # before pytest deselects by markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        if not item.nodeid.startswith(SLOW):
            cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for several in cases.values():
        for item in pairwise(several):
            item.add_marker("quick")


def pairwise(items: list[pytest.Item]) -> list[pytest.Item]:
    """Cases of one test in which every pair of parameter values of all cases occurs."""
    pairs = {item: _pairs(item) for item in items}
    missing = set().union(*pairs.values())
    chosen = []
    while missing:
        best = max(items, key=lambda item: len(pairs[item] & missing))  # of equals the first
        chosen.append(best)
        missing -= pairs[best]
    return chosen


def _pairs(item: pytest.Item) -> set[Hashable]:
    parameters: dict[str, Any] = getattr(getattr(item, "callspec", None), "params", {})
    values = [(name, _key(value)) for name, value in sorted(parameters.items())]
    return {(), *values, *itertools.combinations(values, 2)}


def _key(value: Any) -> Hashable:
    return (type(value), value) if isinstance(value, str | int | float | bool | None) else id(value)
