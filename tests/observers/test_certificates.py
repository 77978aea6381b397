"""Certified boxes: no input, disturbance or noise gets a state out of them, and they are no wider than need be."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env.observers import Box, Certificate, predict
from khop_env.observers.dead_reckoning import extended_drift
from khop_env.physics import (
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

LIMITS = st.floats(0.1, 5.0)
MODELS = {
    "integrator": st.builds(SingleIntegrator, st.sampled_from([1, 2, 3]), LIMITS),
    "drifter": st.builds(DriftingIntegrator, LIMITS),
    "cart": st.builds(DoubleIntegrator, st.floats(0.0, 5.0), LIMITS),
    "unicycle": st.builds(Unicycle, st.tuples(LIMITS, LIMITS)),
    "vessel": st.builds(
        SurfaceVessel,
        mass=st.tuples(st.floats(10, 40), st.floats(10, 40), st.floats(2, 5)),
        linear_drag=st.tuples(*[st.floats(0.5, 5)] * 3),
        quadratic_drag=st.tuples(*[st.floats(0.5, 40)] * 3),
        input_limit=st.floats(0.5, 40),
    ),
}
STEPS, BATCH = 200, 128


@dataclass
class Case:
    """Agents (n, B) that start anywhere in `reach`, and what is known of them."""

    model: AgentModel
    certificate: Certificate
    x: FloatArray
    known: FloatArray
    disturbance: FloatArray
    rng: np.random.Generator


def drawn(model: AgentModel, seed: int) -> Case:
    rng = np.random.default_rng(seed)
    n = model.n
    disturbance = rng.choice([0.0, 0.3], n) * rng.random(n)
    noise = rng.choice([0.0, 0.1]) * rng.random(n)
    reach = rng.choice([0.1, 2.0]) * np.ones(n)
    region = model.operating_region(reach, disturbance)
    x = reach[:, None] * rng.uniform(-1, 1, (n, BATCH))
    error = rng.uniform(-1, 1, (n, BATCH))
    known = x + noise[:, None] * np.where(rng.random(BATCH) < 0.5, error, np.sign(error))
    certificate = Certificate(model, disturbance=disturbance, start=noise, region=region)
    return Case(model, certificate, x, known, disturbance, rng)


def trajectory(case: Case, duration: float) -> list[tuple[FloatArray, FloatArray]]:
    """True and predicted states (n, B) after each of STEPS steps.

    A quarter each: constant extremes, extremes that switch at random, uniform noise, and away from the prediction.
    """
    model, rng = case.model, case.rng
    kind = np.arange(BATCH) % 4
    drift = extended_drift(model, case.certificate.growth)
    constant = [np.sign(rng.uniform(-1, 1, (size, BATCH))) for size in (model.m, model.n)]
    switching = [values.copy() for values in constant]
    x, p, found, h, t = case.x.T, case.known.T, [], duration / STEPS, np.zeros(BATCH)
    for _ in range(STEPS):
        directions, flee = [], np.sign(x - p).T
        for values, held, away in zip(switching, constant, (flee[-model.m :], flee), strict=True):
            switch = rng.random(values.shape) < 0.05
            values[switch] *= -1
            noise = rng.uniform(-1, 1, values.shape)
            directions.append(np.select([kind == 0, kind == 1, kind == 2], [held, values, noise], away))
        u, w = model.input_limit * directions[0].T, case.disturbance * directions[1].T

        def rate(x: FloatArray, u: FloatArray = u, w: FloatArray = w) -> FloatArray:
            return model.drift(t, x) + model.input_map(t, x, u) + w

        x = stepped(rate, x, h)
        p = stepped(lambda p: drift(t, p), p, h)
        found.append((x.T, p.T))
    return found


def stepped(rate: Callable[[FloatArray], FloatArray], x: FloatArray, h: float) -> FloatArray:
    """A Runge-Kutta step of order 4."""
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))


@pytest.mark.parametrize("kind", MODELS)
@settings(max_examples=40)
@given(data=st.data(), seed=SEEDS, duration=st.sampled_from([0.01, 0.1, 0.5, 3.0]))
def test_no_trajectory_leaves_its_box(kind: str, data: st.DataObject, seed: int, duration: float) -> None:
    case = drawn(data.draw(MODELS[kind]), seed)
    growth = case.certificate.growth
    assert growth is not None
    assert case.certificate.certified, case.certificate.reason
    duration = min(duration, 100 * growth.step)
    truth = trajectory(case, duration)
    ages = np.arange(1, STEPS + 1) * duration / STEPS
    radius = case.certificate.radius(ages)
    for step, (x, p) in enumerate(truth):
        rounding = 1e-9 * (1.0 + np.abs(x).max())
        assert (np.abs(x - p) <= radius[:, step, None] + rounding).all()
        if step in (0, 3, 20, 80, STEPS - 1):
            box = case.certificate.box(case.known, np.full(BATCH, ages[step]))
            assert (box.low <= x + rounding).all()
            assert (x <= box.high + rounding).all()
            assert not box.empty().any()


FLEEING = [  # a state, inputs and a disturbance that keep all components at their largest rate
    (SingleIntegrator(2, 1.5), [0, 0], [1, 1], 2.0),
    (DoubleIntegrator(0.7, 2.0), [0, 0, 3, -1], [1, 1], 2.0),
    (DoubleIntegrator(0.0, 2.0), [0, 0, 3, -1], [-1, 1], 5.0),
    (Unicycle((1.5, 0.5)), [0, 0, 0], [1, 0], 2.0),
    (DriftingIntegrator(1.0), [0, 0], [1, 1], 0.05),
    (SurfaceVessel(), [0, 0, 0, 0, 0, 0], [1, 1, 1], 2e-3),
]


@pytest.mark.parametrize(("model", "x", "direction", "age"), FLEEING)
def test_the_radius_is_reached_and_5_percent_less_is_violated(
    model: AgentModel, x: list[float], direction: list[float], age: float
) -> None:
    disturbance = np.full(model.n, 0.01)
    disturbance[model.position_index] = 0.0
    region = model.operating_region(np.zeros(model.n), disturbance)
    certificate = Certificate(model, disturbance=disturbance, region=region)
    state, u, steps = np.array(x, float)[None], model.input_limit * np.array(direction, float), 2000
    w = disturbance * np.sign(np.concatenate([np.zeros(model.n - model.m), direction]))
    for _ in range(steps):
        dt, t = age / steps, np.zeros(1)
        middle = state + dt / 2 * (model.drift(t, state) + model.input_map(t, state, u[None]) + w)
        state = state + dt * (model.drift(t, middle) + model.input_map(t, middle, u[None]) + w)
    known, ages = np.array(x, float)[:, None], np.array([age])
    distance = np.abs(state.T - predict(model, known, ages, 0.0, certificate.growth).state)
    radius = certificate.radius(ages)
    reached = (distance / radius)[:, 0]
    assert (reached <= 1.0 + 1e-6).all()
    exact = isinstance(model, SingleIntegrator | DoubleIntegrator)
    assert (reached.min() if exact else reached.max()) >= 0.95
    too_small = Box.around(predict(model, known, ages, 0.0, certificate.growth).state, 0.95 * radius)
    assert (too_small.far_face(state.T) > 2 * 0.95 * radius).any()  # outside: farther than from face to face


class Undeclared(AgentModel):
    type = "undeclared"
    states = {"x": "m", "v": "m/s"}  # noqa: RUF012
    inputs = {"a": "m/s^2"}  # noqa: RUF012
    position = ("x",)
    input_limit = 1.0
    growth: Growth | None = None

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        return np.stack([x[..., 1], -2.0 * np.sin(x[..., 0])], -1)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.stack([0 * u[..., 0], u[..., 0]], -1)

    def drift_growth(self, region: FloatArray | None = None) -> Growth | None:
        return self.growth


def test_a_model_without_declared_growth_is_not_certified() -> None:
    certificate = Certificate(Undeclared())
    assert not certificate.certified
    assert "not certified: Undeclared.drift_growth()" in certificate.reason
    assert np.isinf(certificate.radius(np.array([0.0, 1.0]))).all()
    box = certificate.box(np.zeros((2, 3)), np.ones(3))
    assert np.isneginf(box.low).all()
    assert np.isposinf(box.high).all()
    assert not Certificate(SurfaceVessel()).certified  # without an operating region
    assert AgentModel.drift_growth(Undeclared()) is None


def test_an_unbounded_input_leaves_what_it_acts_on_uncertified() -> None:
    certificate = Certificate(Unicycle((1.0, np.inf)))
    assert "|g| + |w| has no bound in the state 'heading' of Unicycle" in certificate.reason
    radius = certificate.radius(np.array([0.5]))[:, 0]
    assert radius.tolist() == [pytest.approx(0.5), pytest.approx(0.5), math.inf]
    assert np.isinf(Certificate(DoubleIntegrator(input_limit=np.inf)).radius(np.array([0.5]))).all()
    start = np.array([np.inf, 1.0, 0.0, 0.0])  # nothing is known of one position, all of the rest
    radius = Certificate(DoubleIntegrator(), start=start).radius(np.array([0.0, 0.5]))
    assert np.isinf(radius).tolist() == [[True, True], [False, False], [False, False], [False, False]]


@pytest.mark.parametrize(
    ("matrix", "spread", "message"),
    [
        ([[0, 1], [1.5, 0]], np.inf, r"matrix\[1, 0\] = 1.5, but the rate of 'v' changes by 2 per"),
        ([[0, 0.5], [2, 0]], np.inf, r"matrix\[0, 1\] = 0.5, but the rate of 'x' changes by 1"),
        ([[0, 1], [2, 0]], [np.inf, 3.0], r"spread = 3 for 'v', but its rates at some two states differ by 3.9"),
        ([[0, 1, 0], [2, 0, 0], [0, 0, 0]], np.inf, r"matrix \(3, 3\) for 2 states"),
    ],
)
def test_a_declared_growth_that_is_too_small_is_refused(matrix: object, spread: object, message: str) -> None:
    model = Undeclared()
    model.growth = Growth(np.array(matrix), spread=np.array(spread))
    with pytest.raises(ValueError, match=message):
        Certificate(model)
    model.growth = Growth(np.array([[0.0, 1.0], [2.0, 0.0]]), spread=np.array([np.inf, 4.0]))
    assert Certificate(model).certified


def test_bad_arguments_are_refused() -> None:
    model = DoubleIntegrator()
    for arguments, message in (
        ({"disturbance": -1.0}, "disturbance must be a number or 4 numbers, not negative"),
        ({"start": [1.0, 2.0]}, "start must be a number or 4 numbers"),
        ({"region": np.full(4, np.nan)}, "region must be"),
    ):
        with pytest.raises(ValueError, match=message):
            Certificate(model, **arguments)
    certificate = Certificate(model)
    for ages in ([-0.1], [np.nan, 0.0]):
        with pytest.raises(ValueError, match="not negative"):
            certificate.radius(np.array(ages))
    for ages in ([-0.1], [np.nan], [np.inf], [1e6]):
        with pytest.raises(ValueError, match="ages must be from 0 to 12500 s for DoubleIntegrator"):
            predict(model, np.zeros((4, 1)), np.array(ages), 0.0, certificate.growth)


BOXES = st.tuples(SEEDS, st.integers(1, 3)).map(
    lambda drawn: Box(*np.sort(np.random.default_rng(drawn[0]).normal(size=(2, 3, 4)) * drawn[1], axis=0))
)


@given(BOXES, BOXES, BOXES, SEEDS)
def test_merging_is_commutative_associative_idempotent_and_loses_nothing(a: Box, b: Box, c: Box, seed: int) -> None:
    def same(one: Box, other: Box) -> bool:
        return all(np.array_equal(x, y) for x, y in zip(one, other, strict=True))

    assert same(a.intersect(b), b.intersect(a))
    assert same(a.intersect(b).intersect(c), a.intersect(b.intersect(c)))
    assert same(a.intersect(a), a)
    everything = Box.around(np.zeros((3, 4)), np.full((3, 4), np.inf))
    assert same(a.intersect(everything), a)
    x = np.random.default_rng(seed).normal(size=(3, 4))
    inside = [((box.low <= x) & (x <= box.high)).all(axis=0) for box in (a, b, a.intersect(b))]
    assert ((inside[0] & inside[1]) == inside[2]).all()
    assert not (inside[2] & a.intersect(b).empty()).any()


@given(BOXES, SEEDS)
def test_clipping_never_takes_an_estimate_away_and_the_far_face_bounds_its_error(box: Box, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = box.low + (box.high - box.low) * rng.random((3, 4))
    estimate = rng.normal(size=(3, 4)) * 3
    clipped = box.clip(estimate)
    assert (np.abs(clipped - x) <= np.abs(estimate - x)).all()
    assert (np.abs(clipped - x) <= box.far_face(clipped) + 1e-12).all()
    assert (box.far_face(clipped) <= box.high - box.low + 1e-12).all()


def test_several_messages_of_different_ages_leave_the_state_in_all_their_boxes() -> None:
    case = drawn(DriftingIntegrator(2.0), 3)
    truth = trajectory(case, 1.0)
    merged = Box.around(np.zeros((2, BATCH)), np.full((2, BATCH), np.inf))
    widths = []
    for sent in (20, 150, 90, 20):  # out of order, and one twice
        noise = case.certificate.start[:, None] * np.sign(case.rng.normal(size=(2, BATCH)))
        age = np.full(BATCH, (STEPS - 1 - sent) / STEPS)
        merged = merged.intersect(case.certificate.box(truth[sent][0] + noise, age))
        widths.append((merged.high - merged.low).max())
        assert (merged.low <= truth[-1][0]).all()
        assert (truth[-1][0] <= merged.high).all()
    assert widths[1] < widths[0]


def test_before_anything_has_arrived_the_initial_set_grows() -> None:
    case = drawn(DoubleIntegrator(0.5, 1.0), 1)
    radius = np.full(4, 2.0)
    certificate = Certificate(case.model, disturbance=case.disturbance, start=radius)
    for step, (x, _) in enumerate(trajectory(case, 1.0)):
        box = certificate.box(np.zeros((4, BATCH)), np.full(BATCH, (step + 1) / STEPS))
        assert (box.low <= x).all()
        assert (x <= box.high).all()


def test_a_clock_skew_costs_age_and_drift() -> None:
    """A stamp that is wrong by s: the radius of age + s isn't enough for a cart that rolls; s times its rate is due."""
    cart, skew, age = DoubleIntegrator(0.5, 1.0), 0.1, 0.05
    certificate = Certificate(cart)
    x = np.array([[0.0], [0.0], [10.0], [0.0]])
    truth = predict(cart, x, np.array([age + skew])).state  # it was sent earlier than its stamp says
    center = predict(cart, x, np.array([age])).state
    radius = certificate.radius(np.array([age + skew]))
    assert (np.abs(truth - center) > radius).any()
    fastest = np.array([[10.0], [0.0], [5.0], [0.0]])
    assert (np.abs(truth - center) <= radius + skew * fastest).all()


def test_a_plant_of_euler_steps_leaves_the_box_by_its_own_error() -> None:
    cart, h = DoubleIntegrator(0.5, 1.0), 0.05
    x, p = np.zeros((1, 4)), np.zeros((4, 1))
    x = x + h * (cart.drift(np.zeros(1), x) + cart.input_map(np.zeros(1), x, np.ones((1, 2))))
    ages = np.array([h])
    excess = x[0, 2] / Certificate(cart).radius(ages)[2, 0]
    assert excess == pytest.approx(1.0125, abs=2e-4)
    local = 0.51 * 0.5 * 1.0 * h * np.array([0.0, 0.0, 1.0, 1.0])  # a little over |v''| h / 2, in m/s^2
    assert (np.abs(x.T - p) <= Certificate(cart, disturbance=local).radius(ages)).all()


def test_columns_dont_depend_on_each_other() -> None:
    case, rng = drawn(SurfaceVessel(), 0), np.random.default_rng(0)
    ages = rng.uniform(0.0, 0.5, BATCH)
    box = case.certificate.box(case.known, ages)
    for b in range(0, BATCH, 17):
        alone = case.certificate.box(case.known[:, [b]], ages[[b]])
        for whole, single in zip(box, alone, strict=True):
            np.testing.assert_array_equal(whole[:, [b]], single)
