"""Disturbances: bounds that hold and are reached, purity, smoothness, and who is disturbed."""

import math
import pickle
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.physics import (
    DISTURBANCES,
    BandLimitedNoise,
    Channels,
    Coupling,
    Disturbance,
    DoubleIntegrator,
    DriftingIntegrator,
    Fleet,
    FloatArray,
    Gust,
    Sinusoid,
    Sum,
    SurfaceVessel,
    Term,
    Unicycle,
)
from tests.strategies import SEEDS

FLEET = Fleet([DriftingIntegrator(), DoubleIntegrator(), DoubleIntegrator(), SurfaceVessel(), Unicycle()])
EVERY: dict[str, Disturbance] = {
    "sinusoid": Sinusoid(0.3),
    "noise": BandLimitedNoise((0.1, 0.2, 0.3, 0.4), components=3, agents="cart"),
    "gust": Gust(0.5, agents=("vessel_0", "cart_1")),
    "coupling": Coupling((0.2, 0.7), gain=2.0),
}
EVERY["sum"] = EVERY["sinusoid"] + EVERY["noise"] + EVERY["gust"] + EVERY["coupling"]
EACH = pytest.mark.parametrize("disturbance", EVERY.values(), ids=EVERY)


def evaluate(disturbance: Disturbance, seed: int, batch: int, fleet: Fleet = FLEET) -> tuple[FloatArray, ...]:
    """Random times, states and draws, and the disturbance there."""
    attached, rng = disturbance.attach(fleet), np.random.default_rng(seed)
    t, x = rng.uniform(0, 100, batch), rng.normal(scale=5, size=(batch, fleet.n))
    drawn = np.array([attached.draw(rng) for _ in range(batch)]).reshape(batch, attached.draws)
    return t, x, drawn, attached(t, x, drawn, np.full((batch, fleet.n), np.nan))


def over_time(disturbance: Disturbance, t: FloatArray, seed: int = 0, fleet: Fleet = FLEET) -> FloatArray:
    """One episode's w at the times t and at x = 0."""
    attached = disturbance.attach(fleet)
    drawn = np.tile(attached.draw(np.random.default_rng(seed)), (t.size, 1))
    return attached(t, np.zeros((t.size, fleet.n)), drawn, np.empty((t.size, fleet.n)))


@EACH
@given(seed=SEEDS)
def test_declared_bound_holds(disturbance: Disturbance, seed: int) -> None:
    w = evaluate(disturbance, seed, 50)[-1]
    assert (np.abs(w) <= disturbance.attach(FLEET).bound * (1 + 1e-14)).all()


@pytest.mark.parametrize(
    "disturbance", [EVERY["sinusoid"], EVERY["gust"], EVERY["coupling"], BandLimitedNoise(1.0, components=2)]
)
def test_declared_bound_is_nearly_attained(disturbance: Disturbance) -> None:
    w = evaluate(disturbance, 0, 4000)[-1]
    assert (np.abs(w).max(axis=0) >= 0.99 * disturbance.attach(FLEET).bound).all()
    np.testing.assert_array_equal(w.max(axis=0) > 0, disturbance.attach(FLEET).bound > 0)


@EACH
@given(seed=SEEDS, batch=st.integers(1, 9))
def test_same_arguments_same_bits_in_any_batch(disturbance: Disturbance, seed: int, batch: int) -> None:
    t, x, drawn, w = evaluate(disturbance, seed, batch)
    attached = pickle.loads(pickle.dumps(disturbance)).attach(FLEET)
    copies = t.copy(), x.copy(), drawn.copy()
    np.testing.assert_array_equal(attached(t, x, drawn, np.empty_like(x)), w)
    for b in range(batch):
        row = slice(b, b + 1)
        np.testing.assert_array_equal(attached(t[row], x[row], drawn[row], np.empty((1, FLEET.n))), w[row])
    for now, before in zip((t, x, drawn), copies, strict=True):
        np.testing.assert_array_equal(now, before)


@given(seed=SEEDS)
def test_a_sum_is_the_sum(seed: int) -> None:
    terms = EVERY["sum"].terms
    t, x, drawn, w = evaluate(EVERY["sum"], seed, 5)
    expected, start = np.zeros_like(w), 0
    for term in terms:
        attached = term.attach(FLEET)
        part = drawn[:, start : start + attached.draws]
        expected += attached(t, x, part, np.empty_like(x))
        start += attached.draws
    assert start == drawn.shape[1]
    np.testing.assert_allclose(w, expected, rtol=0, atol=1e-15)
    np.testing.assert_allclose(EVERY["sum"].attach(FLEET).bound, sum(term.attach(FLEET).bound for term in terms))


def test_sums_are_flat_and_may_be_empty() -> None:
    a, b, c = Sinusoid(1.0), Gust(2.0), Coupling(3.0)
    assert (a + b) + c == a + (b + c) == Sum((a, Sum((b, c)))) == Sum((a, b, c))  # type: ignore[arg-type]
    assert a + Sum() == Sum((a,))
    w = evaluate(Sum(), 0, 3)[-1]
    assert Sum().attach(FLEET).draws == 0
    assert not w.any()
    with pytest.raises(TypeError):
        a + 1  # type: ignore[operator]


def test_sinusoid_is_one_sine_per_channel_with_a_frequency_in_range() -> None:
    disturbance = Sinusoid(0.5, frequency=(1.0, 3.0))
    omega, phase = disturbance.attach(FLEET).draw(np.random.default_rng(3)).reshape(2, FLEET.n)
    t = np.linspace(0, 20, 300)
    np.testing.assert_allclose(over_time(disturbance, t, 3), 0.5 * np.sin(t[:, None] * omega + phase), atol=1e-14)
    assert ((omega >= 1) & (omega <= 3)).all()
    assert len(set(omega)) == FLEET.n


def test_noise_covers_its_band_and_has_the_stated_spread() -> None:
    noise = BandLimitedNoise(1.0, band=(2.0, 6.0), components=4)
    draws = noise.attach(FLEET).draw(np.random.default_rng(0)).reshape(2, 4, FLEET.n)
    for j, omega in enumerate(draws[0]):
        assert ((omega >= 2 + j) & (omega <= 3 + j)).all()
    t = np.linspace(0, 500, 20_000)
    w = over_time(noise, t)
    expected = np.sin(t[:, None, None] * draws[0] + draws[1]).sum(axis=1) / 4
    np.testing.assert_allclose(w, expected, atol=1e-12)
    np.testing.assert_allclose(w.std(axis=0), 1 / math.sqrt(8), rtol=0.05)


@given(seed=SEEDS)
def test_gusts_are_continuously_differentiable(seed: int) -> None:
    gust = Gust(2.0, duration=0.7, period=0.9, pulses=3)
    h = 1e-3
    w = over_time(gust, np.arange(0, 6, h), seed)
    slope = np.diff(w, axis=0) / h
    assert np.abs(slope).max() <= math.pi * 2.0 / 0.7 * (1 + 1e-9)
    curvature = 2.0 * 2 * math.pi**2 / 0.7**2
    assert np.abs(np.diff(slope, axis=0)).max() <= curvature * h * 1.001  # a jump of the slope would not shrink with h


def test_gusts_come_once_a_period_with_both_signs_and_repeat() -> None:
    gust = Gust(1.5, duration=1.0, period=4.0, pulses=6)
    t = np.arange(0, 48, 0.01)
    w = over_time(gust, t)
    np.testing.assert_allclose(w[:2400], w[2400:], atol=1e-9)
    peaks = np.abs(w[:2400]).reshape(6, 400, FLEET.n).max(axis=1)
    np.testing.assert_allclose(peaks, 1.5, rtol=1e-3)
    by_window = w[:2400].reshape(6, 400, FLEET.n)
    assert (np.abs(by_window[1:] - by_window[0]).max(axis=1) > 0.01).all()  # each window has a pulse of its own
    blowing = (np.abs(w[:2400]) > 1e-9).mean(axis=0)
    np.testing.assert_allclose(blowing, 0.25, atol=0.01)
    assert w.max() > 1
    assert w.min() < -1


def test_a_gust_may_fill_its_period() -> None:
    w = over_time(Gust(1.0, duration=2.0, period=2.0), np.array([0.0, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(np.abs(w), np.tile([[0.0], [1.0], [0.0], [1.0]], FLEET.n), atol=1e-15)


@given(seed=SEEDS)
def test_coupling_pulls_positions_towards_the_mean(seed: int) -> None:
    _, x, _, w = evaluate(EVERY["coupling"], seed, 4)
    positions = FLEET.positions(x)
    expected = np.zeros_like(x)
    pull = np.array([0.2, 0.7]) * np.tanh(2.0 * (positions.mean(axis=1, keepdims=True) - positions))
    expected[:, FLEET.position_index] = pull
    np.testing.assert_allclose(w, expected, atol=1e-13)


def test_coupling_of_some_agents_still_sees_all() -> None:
    some, every = Coupling(1.0, agents="vessel"), Coupling(1.0)
    _, x, drawn, w = evaluate(every, 0, 3)
    only = some.attach(FLEET)(np.zeros(3), x, drawn, np.empty_like(x))
    vessel = FLEET.state_slice(FLEET.agent("vessel_0"))
    np.testing.assert_array_equal(only[:, vessel], w[:, vessel])
    only[:, vessel] = 0
    assert not only.any()


def test_amplitudes_and_agents_choose_the_components() -> None:
    push = (0.0, 0.0, 0.0, 1.0, 2.0, 3.0)
    bound = Sinusoid(push, agents="vessel").attach(FLEET).bound
    assert bound[FLEET.state_slice(3)].tolist() == list(push)
    assert bound.sum() == 6
    assert Sinusoid(push, agents="vessel").attach(FLEET).draws == 2 * 3  # none for components that stay at rest
    both = Sinusoid(1.0, agents=("cart", "cart_0", "unicycle_0")).attach(FLEET).bound
    assert both.tolist() == [0] * 2 + [1] * 8 + [0] * 6 + [1] * 3


def test_a_users_own_disturbance() -> None:
    class Step(Term):
        def draw(self, rng: np.random.Generator, channels: Channels) -> FloatArray:
            return rng.uniform(1, 2, 1)

        def add(self, t: FloatArray, x: FloatArray, drawn: FloatArray, channels: Channels, out: FloatArray) -> None:
            out[:, channels.index] += channels.amplitude * np.tanh(10 * (t[:, None] - drawn))

    w = over_time(Step(0.5, agents="unicycle") + Gust(0.1), np.array([0.0, 50.0]))
    assert w[:, -1] == pytest.approx([-0.5, 0.5], abs=0.1)


def test_records_made_from_lists_are_the_same() -> None:
    assert Sinusoid([1, 2], frequency=[1, 2], agents=["cart"]) == Sinusoid((1, 2), frequency=(1, 2), agents=("cart",))  # type: ignore[arg-type]
    assert hash(BandLimitedNoise([1.0], band=[1, 2])) == hash(BandLimitedNoise((1.0,), band=(1, 2)))  # type: ignore[arg-type]


def test_kinds() -> None:
    assert {name: type(EVERY[name]) for name in DISTURBANCES} == DISTURBANCES


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sinusoid(-1.0), "Sinusoid.amplitude must be a number .*got -1.0"),
        (lambda: Sinusoid((1.0, math.nan)), "finite and non-negative"),
        (lambda: Sinusoid(1.0, frequency=(2.0, 1.0)), r"Sinusoid.frequency must be \(lowest, highest\)"),
        (lambda: Sinusoid(1.0, frequency=2.0), r"got 2.0"),  # type: ignore[arg-type]
        (lambda: BandLimitedNoise(1.0, band=(0.0, 1.0)), "0 < lowest"),
        (lambda: BandLimitedNoise(1.0, components=0), "components must be an integer from 1 to"),
        (lambda: Gust(1.0, duration=2.0, period=1.0), "<= duration <= period, in s; got duration 2.0, period 1.0"),
        (lambda: BandLimitedNoise(1.0, components=10**9), "from 1 to 10000, as all are drawn beforehand; got 10000000"),
        (lambda: BandLimitedNoise(1.0, components=2.5), "components must be an integer .*; got 2.5"),  # type: ignore[arg-type]
        (lambda: Sinusoid(1.0, frequency=(1.0, 1e300)), r"at most 1e\+06; got"),
        (lambda: Gust(1.0, duration=1e-300, period=1e-300), "1e-06 <= duration <= period"),
        (lambda: Gust(1.0, pulses=0), "pulses must be an integer from 1 to"),
        (lambda: Coupling(1.0, gain=math.inf), "gain must be finite"),
        (lambda: Sinusoid(1.0, agents="vesel").attach(FLEET), "no agent or type 'vesel'; did you mean 'vessel'"),
        (lambda: Gust(1.0, agents=("cart_7",)).attach(FLEET), "no agent or type 'cart_7'; did you mean 'cart_"),
        (lambda: Gust(1.0, agents=()).attach(FLEET), "agents is empty"),
        (lambda: Gust((1.0, 2.0, 3.0)).attach(FLEET), r"3 entries, expected .* states: drifter_0 \(2\), cart_0 \(4\)"),
        (lambda: Coupling((1.0, 2.0, 3.0)).attach(FLEET), r"position axes: drifter_0 \(2\)"),
    ],
)
def test_malformed_disturbances_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
