"""No error is above its certified bound, whatever fleet, graph, network, inputs and disturbances."""

import pytest

from benchmarks.violations import count_violations


def test_a_million_pairs_and_steps_without_a_violation() -> None:
    """Both estimators; some errors come up to their bounds, so that bounds 1 % smaller would be found out."""
    found = count_violations(1e6, seed=1, batch=64)
    assert found.violations == 0
    assert found.pair_steps >= 1e6
    assert found.cases >= 4
    assert found.largest == pytest.approx(1.0, abs=1e-3)
    assert count_violations(1e5, seed=1, batch=64, factor=0.99).violations > 0
