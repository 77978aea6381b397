"""Agent models: their equations, their declared bounds, and how a user adds one."""

import dataclasses
import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from khop_env.physics import (
    MODELS,
    AgentModel,
    DoubleIntegrator,
    DriftingIntegrator,
    Fleet,
    FloatArray,
    SingleIntegrator,
    SurfaceVessel,
    Unicycle,
)
from khop_env.physics.right_hand_sides import drifter_drift
from khop_env.scenarios import mixed_fleet
from tests.strategies import SEEDS

LIBRARY = pytest.mark.parametrize("model", [kind() for kind in MODELS.values()], ids=list(MODELS))


class Pendulum(AgentModel):
    type = "pendulum"
    states = {"angle": "rad", "rate": "rad/s"}  # noqa: RUF012
    inputs = {"torque": "1/s^2"}  # noqa: RUF012
    position = ("angle",)
    input_limit = 2.0

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        return np.stack([x[..., 1], -np.sin(x[..., 0])], -1)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.stack([0 * u[..., 0], u[..., 0]], -1)


def rates(model: AgentModel, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    t = np.zeros(x.shape[:-1])
    return model.drift(t, x) + model.input_map(t, x, u)


def vessel_energy(vessel: SurfaceVessel, x: np.ndarray) -> np.ndarray:
    return 0.5 * (np.array(vessel.mass) * x[..., 3:] ** 2).sum(axis=-1)


def vessel_power(vessel: SurfaceVessel, x: np.ndarray) -> np.ndarray:
    return (np.array(vessel.mass) * x[..., 3:] * vessel.drift(np.zeros(x.shape[:-1]), x)[..., 3:]).sum(axis=-1)


def test_a_pendulum_in_ten_lines() -> None:
    model = Pendulum()
    assert (model.n, model.m, list(model.position_index)) == (2, 1, [0])
    np.testing.assert_array_equal(model.input_limit, np.array([2.0]), strict=True)
    assert model.input_map_bound().tolist() == [0.0, 2.0]
    assert model.input_map_bounded
    assert math.isnan(model.drift_lipschitz())
    assert model == Pendulum()
    assert hash(model) == hash(Pendulum())


@LIBRARY
@given(seed=SEEDS)
def test_right_hand_sides_are_vectorised_over_any_leading_axes(model: AgentModel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(3, 4, model.n)), rng.normal(size=(3, 4, model.m))
    t = rng.uniform(size=(3, 1))
    drift, input_map = model.drift(t, x), model.input_map(t, x, u)
    assert drift.shape == input_map.shape == x.shape
    for b, i in np.ndindex(3, 4):
        np.testing.assert_array_equal(model.drift(t[b], x[b, i]), drift[b, i])
        np.testing.assert_array_equal(model.input_map(t[b], x[b, i], u[b, i]), input_map[b, i])


@LIBRARY
@given(seed=SEEDS)
def test_declared_input_bound_holds_and_is_nearly_attained(model: AgentModel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    u = model.input_limit * np.clip(rng.uniform(-1.5, 1.5, (2000, model.m)), -1, 1)
    g = np.abs(model.input_map(np.zeros(2000), rng.uniform(-4, 4, (2000, model.n)), u))
    assert (g <= model.input_map_bound()).all()
    assert (g.max(axis=0) >= 0.95 * model.input_map_bound()).all()


@LIBRARY
@given(seed=SEEDS)
def test_declared_lipschitz_constant_holds(model: AgentModel, seed: int) -> None:
    a, b = np.random.default_rng(seed).uniform(-3, 3, (2, 500, model.n))
    t = np.zeros(500)
    stretch = np.linalg.norm(model.drift(t, a) - model.drift(t, b), axis=-1) / np.linalg.norm(a - b, axis=-1)
    assert stretch.max() <= model.drift_lipschitz() + 1e-12


def test_drifters_smallest_lipschitz_constant_is_below_the_papers() -> None:
    a, b = np.zeros((1, 2)), np.array([[5e-5, -5e-5]])  # along x1 = -x2 at 0 the sine is steepest
    t = np.zeros(1)
    stretch = np.linalg.norm(DriftingIntegrator().drift(t, a) - DriftingIntegrator().drift(t, b)) / np.linalg.norm(
        a - b
    )
    assert stretch == pytest.approx(1 / math.sqrt(2), rel=1e-8)


def test_double_integrators_constant_is_attained() -> None:
    model = DoubleIntegrator(damping=3.0)
    assert np.linalg.norm(model.drift(np.zeros(()), np.array([0, 0, 1.0, 0]))) == pytest.approx(model.drift_lipschitz())


@given(arrays(np.float64, (2, 3, 2), elements=st.floats(-50, 50)))
def test_drifter_is_the_papers_equation(x: np.ndarray) -> None:
    x1, x2 = x[..., 0], x[..., 1]
    expected = np.stack([np.tanh(0.5 * x1 + 0.5 * x2), np.sin(0.5 * x1 - 0.5 * x2)], axis=-1)
    np.testing.assert_allclose(DriftingIntegrator().drift(np.zeros((2, 1)), x), expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize(("agents", "batch"), [(1, 1), (1, 3000), (700, 3), (2100, 1), (5, 5), (0, 3), (3, 0)])
def test_compiled_drift_takes_strided_columns_of_any_size(agents: int, batch: int) -> None:
    x = np.random.default_rng(0).normal(size=(batch, 2 * agents + 3))[:, 3:].T
    out = np.full((2 * agents, 2 * batch), np.nan)[:, ::2]
    drifter_drift(agents, 0, x, out, 0, batch)
    np.testing.assert_allclose(out[::2], np.tanh(0.5 * x[::2] + 0.5 * x[1::2]), rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(out[1::2], np.sin(0.5 * x[::2] - 0.5 * x[1::2]), rtol=1e-14, atol=1e-15)


def test_textbook_equations() -> None:
    np.testing.assert_array_equal(rates(SingleIntegrator(3), np.ones(3), np.array([1.0, 2, 3])), [1, 2, 3])
    cart = rates(DoubleIntegrator(damping=0.5), np.array([1.0, 2, 3, 4]), np.array([10.0, 20]))
    np.testing.assert_allclose(cart, [3, 4, 10 - 1.5, 20 - 2])
    unicycle = rates(Unicycle(), np.array([5.0, 6, math.pi / 6]), np.array([2.0, 0.7]))
    np.testing.assert_allclose(unicycle, [math.sqrt(3), 1, 0.7])


def test_vessel_by_hand() -> None:
    vessel = SurfaceVessel(mass=(2, 3, 4), linear_drag=(1, 2, 3), quadratic_drag=(0.1, 0.2, 0.3))
    u, v, r = 2.0, -1.0, 0.5
    x = np.array([7.0, 8.0, math.pi / 2, u, v, r])
    expected = [
        -v,  # heading north: surge moves along y, sway along -x
        u,
        r,
        (10 + 3 * v * r - (1 + 0.1 * 2) * u) / 2,
        (20 - 2 * u * r - (2 + 0.2 * 1) * v) / 3,
        (30 + (2 - 3) * u * v - (3 + 0.3 * 0.5) * r) / 4,
    ]
    np.testing.assert_allclose(rates(vessel, x, np.array([10.0, 20, 30])), expected, atol=1e-15)


@given(seed=SEEDS)
def test_vessels_coriolis_forces_do_no_work_and_drag_brakes(seed: int) -> None:
    x = np.random.default_rng(seed).normal(size=(50, 6))
    free = SurfaceVessel(linear_drag=(0, 0, 0), quadratic_drag=(0, 0, 0))
    np.testing.assert_allclose(vessel_power(free, x) / vessel_energy(free, x), 0, atol=1e-12)
    assert (vessel_power(SurfaceVessel(), x) < 0).all()


def test_parameters_in_lists_and_dictionaries_compare_and_hash() -> None:
    """States declared on the instance are a dictionary, and certificates look models up."""

    class Tuned(Pendulum):
        def __init__(self, gains: list[float]) -> None:
            self.gains, self.states = gains, {"angle": "rad", "rate": "rad/s"}
            super().__init__()

    assert Tuned([1.0, 2.0]) == Tuned([1.0, 2.0])
    assert Tuned([1.0, 2.0]) != Tuned([1.0, 3.0])
    assert hash(Tuned([1.0, 2.0])) == hash(Tuned([1.0, 2.0]))


def test_equal_parameters_compare_equal_and_hash_alike() -> None:
    assert Unicycle() == Unicycle(input_limit=[1.0, 2.0])
    assert hash(Unicycle()) == hash(Unicycle(input_limit=(1.0, 2.0)))
    assert SingleIntegrator(2, input_limit=1) == SingleIntegrator(2, input_limit=(1.0, 1.0))
    assert DoubleIntegrator(0.1) != DoubleIntegrator(0.2)
    assert SingleIntegrator(2) != DriftingIntegrator(1.0)
    assert SurfaceVessel(mass=[25.8, 33.8, 2.76]) == SurfaceVessel()  # type: ignore[arg-type]
    assert pickle.loads(pickle.dumps(Unicycle())) == Unicycle()
    assert dataclasses.replace(DoubleIntegrator(0.1), damping=0.2) == DoubleIntegrator(0.2)


def test_an_unlimited_input_makes_what_depends_on_it_unbounded() -> None:
    vessel = SurfaceVessel(input_limit=(1.0, np.inf, 1.0))
    assert np.isinf(vessel.input_map_bound()).tolist() == [False, False, False, False, True, False]
    assert not vessel.input_map_bounded


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"position": ("angel",)}, "'angel' is not a state; did you mean 'angle'"),
        ({"position": "angle"}, "tuple of different state names"),
        ({"position": ()}, "tuple of different state names"),
        ({"type": "Pendulum"}, "lower-case"),
        ({"type": "pendulum_2"}, "end with a letter"),
        ({"type": "pendulum_"}, "end with a letter"),
        ({"states": ["angle", "rate"]}, "states must map each name to its unit"),
        ({"inputs": {}}, "inputs must map each name to its unit"),
        ({"input_limit": (1.0, 2.0)}, r"one per input \('torque',\)"),
        ({"input_limit": -1.0}, "must be positive"),
        ({"input_limit": math.nan}, "must be positive"),
    ],
)
def test_malformed_models_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        type("Broken", (Pendulum,), changes)()


def test_missing_parts_are_named() -> None:
    with pytest.raises(ValueError, match="Empty doesn't set `type`"):
        type("Empty", (AgentModel,), {})()
    bare = type(
        "Bare",
        (AgentModel,),
        {k: getattr(Pendulum, k) for k in Pendulum.__dict__ if k[0] != "_"} | {"drift": AgentModel.drift},
    )()
    with pytest.raises(NotImplementedError, match=r"Bare has no drift\(t, x\)"):
        bare.drift(np.zeros(1), np.zeros((1, 2)))


def test_library_parameters_are_checked() -> None:
    with pytest.raises(ValueError, match="must be 1, 2 or 3; got 4"):
        SingleIntegrator(4)
    with pytest.raises(ValueError, match="mass must be three positive, finite numbers"):
        SurfaceVessel(mass=(1, 0, 1))
    for dim in (2.0, True, "2"):
        with pytest.raises(ValueError, match="must be 1, 2 or 3"):
            SingleIntegrator(dim)
    for damping in (math.nan, math.inf, -1e9):
        with pytest.raises(ValueError, match="damping must be finite and not negative"):
            DoubleIntegrator(damping)
    for name in ("mass", "linear_drag", "quadratic_drag"):
        for value in (math.nan, math.inf, -1.0):
            with pytest.raises(ValueError, match=rf"{name} must be three .*, finite numbers .*; got \(1.0, {value}"):
                SurfaceVessel(**{name: (1.0, value, 1.0)})


class TestExplicitStep:
    """The longest explicit step that a drift declares; simulators divide longer steps."""

    def test_slow_and_bounded_drifts_take_any(self) -> None:
        for model in (SingleIntegrator(), DriftingIntegrator(), Unicycle(), DoubleIntegrator(damping=0.0)):
            assert model.explicit_step(np.full(model.n, 1e6), np.full(model.n, 1e6)) == math.inf

    def test_a_cart_takes_its_time_constant(self) -> None:
        assert DoubleIntegrator(damping=4.0).explicit_step(np.ones(4), np.zeros(4)) == 0.25

    def test_a_vessel_takes_less_the_faster_it_gets(self) -> None:
        """By its start, its inputs or a disturbance; the usual steps of 0.05 s are never divided in mixed_fleet."""
        slow, still = np.zeros(6), np.zeros(6)
        vessel, strong = SurfaceVessel(), SurfaceVessel(input_limit=(30.0, 40.0, 5.0))
        fast, pushed = np.array([0, 0, 0, 5.0, 5.0, 5.0]), np.array([0, 0, 0, 1.0, 1.0, 1.0])
        usual = vessel.explicit_step(slow, still)
        assert 0.1 < usual < 1.0
        for shorter in (
            vessel.explicit_step(fast, still),
            vessel.explicit_step(slow, pushed),
            strong.explicit_step(slow, still),
        ):
            assert shorter < usual
        assert SurfaceVessel(input_limit=math.inf).explicit_step(slow, still) > usual  # nothing is known but the start
        chosen = mixed_fleet()
        bound = chosen.disturbance.attach(chosen.fleet).bound
        assert chosen.fleet.explicit_step(chosen.initial.radius, bound) == (pytest.approx(0.0555, abs=1e-4), 9)

    @pytest.mark.parametrize("order", [1, 2])
    def test_a_vessel_does_not_diverge_in_steps_of_its_own(self, order: int) -> None:
        """With inputs at their limits that flip, stay, or push along the motion, which raises the energy most."""
        rng = np.random.default_rng(0)
        for vessel in (SurfaceVessel(), SurfaceVessel(input_limit=(30.0, 40.0, 5.0))):
            dt = vessel.explicit_step(np.zeros(6), np.zeros(6))
            limit, t = vessel.input_limit, np.zeros((30, 1))
            x, held = np.zeros((30, 1, 6)), rng.choice((-1.0, 1.0), (30, 1, 3))
            for _ in range(2000):
                flip = rng.choice((-1.0, 1.0), (30, 1, 3))
                push = np.where(x[..., 3:] >= 0.0, 1.0, -1.0)
                u = limit * np.concatenate([flip[:10], held[10:20], push[20:]])
                rate = vessel.drift(t, x) + vessel.input_map(t, x, u)
                if order == 2:
                    middle = x + 0.5 * dt * rate
                    rate = vessel.drift(t, middle) + vessel.input_map(t, middle, u)
                x = x + dt * rate
            assert np.abs(x[..., 3:]).max() < 25.0

    def test_a_step_that_is_none_is_refused(self) -> None:
        model = SingleIntegrator()
        object.__setattr__(model, "explicit_step", lambda reach, disturbance: 0.0)
        with pytest.raises(
            ValueError, match=r"explicit_step must return a positive number .*; got 0\.0 for 'integrator_1'"
        ):
            Fleet([DoubleIntegrator(), SingleIntegrator(), model]).explicit_step(np.zeros(8), np.zeros(8))
