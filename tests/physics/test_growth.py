"""Declared growth of drifts: bounds on Jacobians, differences of rates, and a ship's operating region."""

import math

import numpy as np
import pytest
from hypothesis import given

from khop_env.physics import (
    MODELS,
    AgentModel,
    DoubleIntegrator,
    DriftingIntegrator,
    FloatArray,
    Growth,
    SingleIntegrator,
    SurfaceVessel,
    Unicycle,
)
from tests.strategies import SEEDS

LIBRARY = pytest.mark.parametrize("model", [kind() for kind in MODELS.values()], ids=list(MODELS))
REGION = np.array([math.inf, math.inf, math.inf, 1.5, 0.7, 0.4])


def declared(model: AgentModel) -> Growth:
    growth = model.drift_growth(REGION if isinstance(model, SurfaceVessel) else None)
    assert growth is not None
    return growth


def jacobian(model: AgentModel, x: FloatArray) -> FloatArray:
    """(B, n, n) by central differences."""
    t, step = np.zeros(len(x)), 1e-6
    columns = []
    for state in range(model.n):
        shift = step * np.eye(model.n)[state]
        columns.append((model.drift(t, x + shift) - model.drift(t, x - shift)) / (2 * step))
    return np.stack(columns, -1)


@LIBRARY
@given(seed=SEEDS)
def test_jacobians_and_differences_of_rates_are_within_the_declared_bounds(model: AgentModel, seed: int) -> None:
    growth, rng = declared(model), np.random.default_rng(seed)
    reach = np.where(np.isfinite(growth.region), growth.region - 1e-5, rng.choice([0.1, 5.0]))
    x = reach * np.clip(rng.uniform(-1.3, 1.3, (400, model.n)), -1, 1)
    found = jacobian(model, x)
    diagonal = np.eye(model.n, dtype=bool)
    assert (np.where(diagonal, found, np.abs(found)) <= growth.matrix + 1e-7).all()
    rates = model.drift(np.zeros(400), x)
    assert (np.abs(rates[:200] - rates[200:]) <= growth.spread + 1e-12).all()


def test_the_bounds_are_attained() -> None:
    x = np.array([[0.0, 0.0]])
    found = np.abs(jacobian(DriftingIntegrator(), x)[0])
    np.testing.assert_allclose(found, declared(DriftingIntegrator()).matrix, rtol=1e-9)
    cart = DoubleIntegrator(0.7)
    np.testing.assert_allclose(jacobian(cart, np.ones((1, 4)))[0], declared(cart).matrix, atol=1e-9)
    vessel, (U, V, R) = SurfaceVessel(), REGION[3:]
    at = np.array([[0, 0, 0.3, a * U, b * V, c * R] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    ahead = np.array([[0, 0, angle, U, V, 0] for angle in np.linspace(0, 6.3, 2001)])
    still = np.zeros((1, 6))
    found = np.max([np.abs(jacobian(vessel, states)).max(axis=0) for states in (at, ahead)], axis=0)
    found[3:, 3:][np.eye(3, dtype=bool)] = np.diag(jacobian(vessel, still)[0])[3:]
    np.testing.assert_allclose(found, declared(vessel).matrix, rtol=1e-5, atol=1e-6)


def test_other_models_have_no_region_and_none_is_needed() -> None:
    for model in (SingleIntegrator(3), Unicycle(), DriftingIntegrator(), DoubleIntegrator()):
        assert np.isinf(model.operating_region(np.ones(model.n), np.zeros(model.n))).all()
        assert model.drift_growth() is not None
        assert np.isinf(declared(model).region).all()
    for missing in (3, 4, 5):
        region = REGION.copy()
        region[missing] = math.inf
        assert SurfaceVessel().drift_growth(region) is None
    assert SurfaceVessel().drift_growth() is None


def pushed(vessel: SurfaceVessel, w: FloatArray, start: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(6,) largest |x| of ships from the corners of `start`, pushed along their velocity or at random."""
    x = start * np.sign(rng.uniform(-1, 1, (64, 6)))
    largest, step, t = np.abs(x).max(axis=0), vessel.explicit_step(start, w) / 4, np.zeros(64)
    random = np.sign(rng.uniform(-1, 1, (64, 3)))
    for _ in range(1500):
        flip = rng.random(random.shape) < 0.02
        random[flip] *= -1
        direction = np.where((np.arange(64) < 32)[:, None], np.sign(x[:, 3:]), random)
        u, push = vessel.input_limit * direction, np.concatenate([np.zeros((64, 3)), w[3:] * direction], axis=1)
        middle = x + step / 2 * (vessel.drift(t, x) + vessel.input_map(t, x, u) + push)
        x = x + step * (vessel.drift(t, middle) + vessel.input_map(t, middle, u) + push)
        largest = np.maximum(largest, np.abs(x).max(axis=0))
    return largest


@pytest.mark.parametrize("seed", range(6))
def test_ships_never_leave_their_operating_region(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vessel = (
        SurfaceVessel()
        if seed == 0
        else SurfaceVessel(
            mass=tuple(rng.uniform(5, 40, 3)),
            linear_drag=tuple(rng.uniform(0.0, 5, 3)),
            quadratic_drag=tuple(rng.uniform(0.5, 40, 3)),
            input_limit=rng.uniform(0.5, 30, 3),
        )
    )
    w, start = np.array([0, 0, 0, 0.1, 0.1, 0.1]), np.array([0, 0, 0, 0.2, 0.2, 0.1])
    region = vessel.operating_region(start, w)
    assert np.isinf(region[:3]).all()
    assert np.isfinite(region[3:]).all()
    largest = pushed(vessel, w, start, rng)
    assert (largest <= region).all()
    assert (largest / region)[3:].max() > 0.5  # and it isn't far off


@pytest.mark.parametrize("step", [0.05, 0.2])
def test_ships_in_euler_steps_stay_in_their_operating_region(step: float) -> None:
    """Measured: an Euler step adds energy, which the region, derived for continuous time, doesn't count."""
    rng, vessel, ships = np.random.default_rng(0), SurfaceVessel(), 400
    w, start = np.array([0, 0, 0, 0.1, 0.1, 0.1]), np.array([0, 0, 0, 0.2, 0.2, 0.1])
    region = vessel.operating_region(start, w)[3:]
    x, t = start * np.sign(rng.uniform(-1, 1, (ships, 6))), np.zeros(ships)
    random, raising, largest = np.sign(rng.uniform(-1, 1, (ships, 3))), np.arange(ships) < ships // 2, np.zeros(3)
    for _ in range(round(20.0 / step)):
        random[rng.random(random.shape) < 0.5 * step] *= -1  # every two seconds
        direction = np.where(raising[:, None], np.where(x[:, 3:] < 0.0, -1.0, 1.0), random)
        push = np.concatenate([np.zeros((ships, 3)), w[3:] * direction], axis=1)
        x = x + step * (vessel.drift(t, x) + vessel.input_map(t, x, vessel.input_limit * direction) + push)
        largest = np.maximum(largest, np.abs(x[:, 3:]).max(axis=0))
    assert 0.5 < (largest / region).max() < 0.9


def test_a_ship_in_one_direction_reaches_its_region() -> None:
    """With much drag elsewhere the region is the speed at which drag balances the force."""
    vessel = SurfaceVessel(linear_drag=(2.0, 1e3, 1e3), quadratic_drag=(3.0, 1.0, 1.0), input_limit=(5.0, 1e-9, 1e-9))
    assert vessel.operating_region(np.zeros(6), np.zeros(6))[3] == pytest.approx(1.0, rel=1e-3)  # 2 v + 3 v^2 = 5
    fast = vessel.operating_region(np.array([0, 0, 0, 7.0, 0, 0]), np.zeros(6))
    assert fast[3] == pytest.approx(7.0)  # it starts faster than that


def test_without_drag_or_with_unlimited_force_there_is_no_region() -> None:
    for vessel in (
        SurfaceVessel(linear_drag=(0, 0, 0), quadratic_drag=(0, 0, 0)),
        SurfaceVessel(linear_drag=(0, 1, 1), quadratic_drag=(0, 1, 1)),
        SurfaceVessel(input_limit=(np.inf, 1.0, 1.0)),
    ):
        assert np.isinf(vessel.operating_region(np.ones(6), np.zeros(6))).all()
    linear = SurfaceVessel(linear_drag=(1.0, 2.0, 3.0), quadratic_drag=(0, 0, 0))
    assert np.isfinite(linear.operating_region(np.ones(6), np.zeros(6))[3:]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"matrix": np.zeros((2, 3))}, "square matrix of finite numbers"),
        ({"matrix": np.array([[0.0, np.nan], [0.0, 0.0]])}, "square matrix of finite numbers"),
        ({"matrix": np.array([[0.0, -1.0], [0.0, 0.0]])}, "never negative"),
        ({"matrix": np.eye(2), "spread": np.array([1.0, -1.0])}, r"Growth.spread must be a number or 2 numbers"),
        ({"matrix": np.eye(2), "spread": np.array([1.0, np.nan])}, r"Growth.spread must be"),
        ({"matrix": np.eye(2), "region": np.array([1.0, 0.0])}, r"Growth.region must be .*, positive"),
        ({"matrix": np.eye(2), "region": np.ones(3)}, r"Growth.region must be"),
        ({"matrix": np.eye(2), "step": 0.0}, r"Growth.step must be positive"),
    ],
)
def test_bad_growth_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Growth(**arguments)
