"""Dead reckoning: it follows the drift, and says how far its own steps may have gone wrong."""

import numpy as np
import pytest
from hypothesis import given, settings

from khop_env.observers import Certificate, predict
from khop_env.observers.dead_reckoning import extended_drift
from khop_env.physics import (
    MODELS,
    AgentModel,
    DoubleIntegrator,
    DriftingIntegrator,
    FloatArray,
    SingleIntegrator,
    SurfaceVessel,
    Unicycle,
)
from tests.strategies import SEEDS

DRIFTING = [DriftingIntegrator(1.0), DoubleIntegrator(4.0), SurfaceVessel()]


@pytest.mark.parametrize("model", DRIFTING, ids=lambda model: model.type)
def test_the_error_is_included(model: AgentModel) -> None:
    """In what the prediction says, and the millionth by which a radius is raised; for a linear drift in the former."""
    rng, n = np.random.default_rng(0), model.n
    region = model.operating_region(np.full(n, 0.5), np.zeros(n))
    certificate = Certificate(model, region=region)
    x = np.where(np.isfinite(region), region / np.sqrt(3.0), 2.0)[:, None] * rng.uniform(-1, 1, (n, 4000))
    age = 10 ** rng.uniform(-3, 0, 4000)
    found = predict(model, x, age, 0.0, certificate.growth)

    drift, wanted, t, h = extended_drift(model, certificate.growth), x.T, np.zeros(4000), (age / 1500)[:, None]
    for _ in range(1500):
        k1 = drift(t, wanted)
        k2 = drift(t, wanted + h / 2 * k1)
        k3 = drift(t, wanted + h / 2 * k2)
        wanted = wanted + h / 6 * (k1 + 2 * k2 + 2 * k3 + drift(t, wanted + h * k3))
    left = np.abs(found.state - wanted.T) - found.error
    rounding = 1e-13 * (1.0 + np.abs(wanted.T))
    assert (left <= rounding + (0.0 if model.type == "cart" else 1e-6) * certificate.radius(age)).all()
    assert (found.error < 1e-4 * certificate.radius(age)).all()


@pytest.mark.parametrize("model", [SingleIntegrator(3), Unicycle()], ids=lambda model: model.type)
def test_without_a_drift_the_state_stays_to_the_last_bit(model: AgentModel) -> None:
    x = np.random.default_rng(0).normal(size=(model.n, 20))
    found = predict(model, x, np.linspace(0, 1e4, 20), 0.0, model.drift_growth())
    np.testing.assert_array_equal(found.state, x)
    assert not found.error.any()


@settings(max_examples=20)
@given(seed=SEEDS)
def test_columns_have_their_own_number_of_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for model in (kind() for kind in MODELS.values()):
        x, age = rng.normal(size=(model.n, 5)), 10 ** rng.uniform(-4, 0, 5)
        growth = model.drift_growth(np.full(model.n, 3.0))
        together = predict(model, x, age, 0.0, growth)
        for b in range(5):
            alone = predict(model, x[:, [b]], age[[b]], 0.0, growth)
            np.testing.assert_array_equal(alone.state, together.state[:, [b]])
            np.testing.assert_array_equal(alone.error, together.error[:, [b]])


class Clock(AgentModel):
    type = "clock"
    states = {"x": "m"}  # noqa: RUF012
    inputs = {"v": "m/s"}  # noqa: RUF012
    position = ("x",)
    input_limit = 1.0

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        return np.cos(t)[..., None] + 0.0 * x

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        return u


def test_a_drift_in_time_begins_when_the_state_was_measured() -> None:
    t, age = np.array([0.0, 1.0, 7.0]), np.array([0.5, 0.0, 2.0])
    found = predict(Clock(), np.zeros((1, 3)), age, t).state[0]
    np.testing.assert_allclose(found, np.sin(t + age) - np.sin(t), atol=1e-9)


def test_outside_the_region_the_drift_goes_on_with_its_declared_slope() -> None:
    vessel = SurfaceVessel()
    growth = vessel.drift_growth(np.array([np.inf, np.inf, np.inf, 1.0, 1.0, 1.0]))
    assert growth is not None
    ahead = predict(vessel, np.array([[0, 0, 0, 50.0, 0, 0]]).T, np.array([1e-3]), 0.0, growth).state[:, 0]
    inside = vessel.drift(np.zeros(()), np.array([0, 0, 0, 1.0, 0, 0]))
    rate = inside[3] - vessel.linear_drag[0] / vessel.mass[0] * 49.0  # not the quadratic drag of 50 m/s
    assert ahead[3] - 50.0 == pytest.approx(1e-3 * rate, rel=1e-3)
    assert ahead[0] == pytest.approx(1e-3 * 1.0)
