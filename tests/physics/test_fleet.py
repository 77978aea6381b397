"""The fleet against a loop over its agents."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.physics import (
    AgentModel,
    DoubleIntegrator,
    DriftingIntegrator,
    Fleet,
    FloatArray,
    SingleIntegrator,
    SurfaceVessel,
    Unicycle,
)
from tests.strategies import SEEDS


class Swing(AgentModel):
    """Moves with time, and differently in each of its two states."""

    type = "swing"
    states = {"x": "m", "y": "m"}  # noqa: RUF012
    inputs = {"push": "m/s"}  # noqa: RUF012
    position = ("y", "x")
    input_limit = 1.0

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        return np.stack([np.cos(t) * x[..., 1], t + 0 * x[..., 0]], -1)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.stack([t * u[..., 0], u[..., 0]], -1)

    def input_map_bound(self) -> FloatArray:
        return np.array([np.inf, 1.0])


class Wrong(Swing):
    type = "wrong"

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        return np.asarray(x[..., 0])


MODELS = [
    SingleIntegrator(),
    DriftingIntegrator(),
    DoubleIntegrator(),
    DoubleIntegrator(2.0),
    Unicycle(),
    SurfaceVessel(),
    Swing(),
]
MIXED = st.lists(st.sampled_from(MODELS), min_size=1, max_size=9)


@given(models=MIXED, seed=SEEDS, batch=st.integers(0, 4))
def test_fleet_equals_a_loop_over_agents(models: list, seed: int, batch: int) -> None:
    fleet, rng = Fleet(models), np.random.default_rng(seed)
    t, x, u = rng.uniform(0, 9, batch), rng.normal(size=(batch, fleet.n)), rng.normal(size=(batch, fleet.m))
    before = x.copy(), u.copy()
    drift, input_map, positions = fleet.drift(t, x), fleet.input_map(t, x, u), fleet.positions(x)
    assert drift.shape == input_map.shape == (batch, fleet.n)
    assert positions.shape == (batch, len(models), 2)
    for b in range(batch):
        for i, model in enumerate(models):
            states, inputs = fleet.state_slice(i), fleet.input_slice(i)
            np.testing.assert_array_equal(drift[b, states], model.drift(t[b], x[b, states]))
            np.testing.assert_array_equal(input_map[b, states], model.input_map(t[b], x[b, states], u[b, inputs]))
            np.testing.assert_array_equal(positions[b, i], x[b, states][model.position_index])
    np.testing.assert_array_equal(x, before[0])
    np.testing.assert_array_equal(u, before[1])


@given(models=MIXED)
def test_layout(models: list) -> None:
    fleet = Fleet(models)
    assert len(fleet) == len(models)
    assert np.diff(fleet.state_offset).tolist() == [model.n for model in models]
    assert np.diff(fleet.input_offset).tolist() == [model.m for model in models]
    assert (fleet.n, fleet.m) == (fleet.state_offset[-1], fleet.input_offset[-1])
    assert [name for name, *_ in fleet.component_names()] == [
        i for i, m in zip(fleet.ids, models, strict=True) for _ in m.states
    ]
    assert [(name, unit) for _, name, unit in fleet.input_names()] == [
        entry for m in models for entry in m.inputs.items()
    ]
    np.testing.assert_array_equal(fleet.input_limit, np.concatenate([m.input_limit for m in models]))
    np.testing.assert_array_equal(fleet.input_map_bound, np.concatenate([m.input_map_bound() for m in models]))
    assert [fleet.agent(name) for name in fleet.ids] == list(range(len(models)))


@given(models=MIXED)
def test_groups_are_maximal_runs_of_equal_models_and_views(models: list) -> None:
    fleet = Fleet(models)
    assert [model for group in fleet.groups for model in [group.model] * group.size] == models
    for left, right in zip(fleet.groups, fleet.groups[1:], strict=False):
        assert left.stop == right.start
        assert left.model != right.model
    x = np.zeros((3, fleet.n))
    for group in fleet.groups:
        view = x[:, group.state_slice].reshape(3, *group.state_shape)
        assert view.shape == (3, group.size, group.model.n)
        assert np.shares_memory(view, x)
        view += 1
    assert (x == 1).all()


def test_equal_models_form_one_group_even_if_they_are_different_objects() -> None:
    assert len(Fleet([DriftingIntegrator(3.0), DriftingIntegrator([3.0, 3.0])]).groups) == 1
    assert len(Fleet([Swing(), Swing()]).groups) == 1
    assert len(Fleet([DoubleIntegrator(0.1), DoubleIntegrator(0.2)]).groups) == 2


def test_ids_count_within_the_type() -> None:
    fleet = Fleet([Unicycle(), SingleIntegrator(), Unicycle((1, 1)), SingleIntegrator()])
    assert fleet.ids == ("unicycle_0", "integrator_0", "unicycle_1", "integrator_1")
    assert fleet.component_names()[2] == ("unicycle_0", "heading", "rad")
    assert fleet.input_names()[-1] == ("integrator_1", "vy", "m/s")
    assert repr(fleet) == "Fleet(2 unicycle, 2 integrator)"


def test_results_go_into_out_and_are_never_views() -> None:
    fleet = Fleet([SingleIntegrator()] * 2)
    t, x, u = np.zeros(3), np.zeros((3, 4)), np.ones((3, 4))
    out = np.full((3, 4), np.nan)
    assert fleet.drift(t, x, out) is out
    assert fleet.input_map(t, x, u, out) is out
    assert not np.shares_memory(fleet.input_map(t, x, u), u)


def test_agent_takes_an_id_or_an_index() -> None:
    fleet = Fleet([Unicycle(), SurfaceVessel()])
    assert fleet.agent("vessel_0") == fleet.agent(1) == fleet.agent(np.int64(1)) == 1
    with pytest.raises(ValueError, match="no agent 'vesel_0'; did you mean 'vessel_0'"):
        fleet.agent("vesel_0")
    for index in (2, -1):
        with pytest.raises(ValueError, match="agents are 0 to 1"):
            fleet.agent(index)


def test_malformed_fleets_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one agent"):
        Fleet([])
    with pytest.raises(ValueError, match=r"agent 1: expected an AgentModel, got .*Unicycle.*parentheses"):
        Fleet([Unicycle(), Unicycle])  # type: ignore[list-item]
    with pytest.raises(ValueError, match=r"most have 2, but not integrator_0 \(3\)"):
        Fleet([Unicycle(), SingleIntegrator(3), Unicycle()])
    with pytest.raises(
        ValueError, match="integrator_1 and integrator_0 share the type 'integrator' but differ in their states"
    ):
        Fleet([SingleIntegrator(2), SingleIntegrator(3)])


def test_a_wrong_shape_names_the_model() -> None:
    with pytest.raises(ValueError, match=r"Wrong.drift\(t, x\) on x .* returned shape \(4, 3\), expected \(4, 3, 2\)"):
        Fleet([Wrong(), Wrong()])


class Indexed(Swing):
    """A right-hand side by whichever formula a test gives."""

    type = "indexed"

    def __init__(self, drift: Any, input_map: Any = None) -> None:
        self.formula, self.inputs_formula = drift, input_map
        super().__init__()

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        return self.formula(t, x)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        return super().input_map(t, x, u) if self.inputs_formula is None else self.inputs_formula(x, u)


@pytest.mark.parametrize(
    ("drift", "message"),
    [
        (lambda t, x: np.stack([x[5], -x[6]], axis=-1), r"drift\(t, x\) raised IndexError .* 'x' is x\[..., 0\]"),
        (lambda t, x: np.stack([x[0], -x[1]]), r"returned shape \(2, 3, 2\), expected \(4, 3, 2\)"),
        (lambda t, x: np.stack([x[:, 0], -x[:, 1]], axis=-1), r"returned shape \(4, 2, 2\)"),
        (lambda t, x: np.stack([x[..., 1], -x[..., 0]], axis=0), r"returned shape \(2, 4, 3\)"),
        (lambda t, x: -x[..., :1], r"returned shape \(4, 3, 1\)"),
        (lambda t, x: t * x[..., 0], r"returned shape \(4, 3\)"),
        (lambda t, x: AgentModel.drift(None, t, x), r"has no drift\(t, x\)"),  # type: ignore[arg-type]
    ],
)
def test_a_drift_that_takes_no_batches_is_refused_before_anything_runs(drift: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Fleet([Indexed(drift)])


def test_an_input_map_that_takes_no_batches_is_refused_with_the_reason() -> None:
    with pytest.raises(ValueError, match=r"input_map\(t, x, u\) raised IndexError .* the states are the last axis"):
        Fleet([Indexed(lambda t, x: -x, lambda x, u: np.stack([u[1], u[2]]))])


class Mapped(Swing):
    """A single input to two states by whichever formula a test gives."""

    type = "mapped"

    def __init__(self, formula, limit=2.0, uses_state=False, bound=None) -> None:
        self.formula, self.input_limit, self.input_map_uses_state, self.bound = formula, limit, uses_state, bound
        super().__init__()

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.asarray(self.formula(t, x, u))

    def input_map_bound(self) -> FloatArray:
        return AgentModel.input_map_bound(self) if self.bound is None else np.asarray(self.bound)


def both(t, x, u):
    return np.concatenate([u, 3.0 * u], -1)


def turned(t, x, u):
    return np.stack([np.cos(x[..., 0]) * u[..., 0], np.sin(x[..., 0]) * u[..., 0]], -1)


@pytest.mark.parametrize(
    ("model", "said"),
    [
        (Mapped(turned), "depends on the state: set input_map_uses_state = True"),
        (Mapped(turned, bound=[2.0, 2.0]), "depends on the state: set input_map_uses_state = True"),
        (
            Mapped(turned, uses_state=True),
            r"depends on the state.*write input_map_bound\(self\), returning the largest",
        ),
        (Mapped(lambda t, x, u: both(t, x, u * u), np.inf), "isn't affine in each input.*write input_map_bound"),
        (Mapped(lambda t, x, u: both(t, x, np.sin(u)), 3.1), "isn't affine in each input.*write input_map_bound"),
        (Mapped(lambda t, x, u: both(t, x, t[..., None] * u)), "depends on time.*write input_map_bound"),
        (Mapped(lambda t, x, u: u), r"Mapped.input_map\(t, x, u\) returned shape \(1, 2, 1\), expected \(1, 2, 2\)"),
        (Mapped(lambda t, x, u: u[..., 0], bound=[1.0, 1.0]), r"input_map\(t, x, u\) returned shape \(1, 2\)"),
        (Mapped(both, bound=[1.0]), "must return 2 numbers that aren't negative, one for each state"),
        (Mapped(both, bound=[1.0, np.nan]), "must return 2 numbers that aren't negative"),
    ],
)
def test_an_input_map_whose_bound_cannot_be_known_is_refused(model: Mapped, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Fleet([model])


def test_bounds_of_input_maps() -> None:
    assert Fleet([Mapped(both)]).input_map_bound.tolist() == [2.0, 6.0]
    assert np.isinf(Fleet([Mapped(both, np.inf)]).input_map_bound).all()
    free = Mapped(lambda t, x, u: np.concatenate([u, 0.0 * u + 1.0], -1), np.inf)
    assert Fleet([free]).input_map_bound.tolist() == [np.inf, 1.0]
    saturated = Mapped(turned, np.inf, uses_state=True, bound=[1.0, np.inf])  # one method is all it takes
    assert Fleet([saturated]).input_map_bound.tolist() == [1.0, np.inf]
