"""Compiled right-hand sides against the equations in NumPy, and over ranges, layouts and shapes."""

import numpy as np
import pytest

from khop_env.physics import (
    DoubleIntegrator,
    DriftingIntegrator,
    Fleet,
    SingleIntegrator,
    SurfaceVessel,
    Unicycle,
    velocity_to_input,
)
from khop_env.physics.right_hand_sides import drifts, input_maps

RNG = np.random.default_rng(0)
VESSEL = SurfaceVessel(mass=(20.0, 30.0, 3.0), linear_drag=(0.5, 0.9, 1.5), quadratic_drag=(1.0, 30.0, 0.5))


def rotation(heading):
    """(..., 3, 3) from body to earth."""
    cos, sin, zero = np.cos(heading), np.sin(heading), np.zeros_like(heading)
    rows = [[cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1.0]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def test_the_vessels_equation_is_fossens():
    """eta' = R nu and M nu' = -C(nu) nu - D(nu) nu, by matrices."""
    x = RNG.normal(size=(50, 4, 6)) * 2.0
    nu, (m1, m2, m3) = x[..., 3:], VESSEL.mass
    coriolis = np.zeros((50, 4, 3, 3))
    coriolis[..., 0, 2], coriolis[..., 1, 2] = -m2 * nu[..., 1], m1 * nu[..., 0]
    coriolis -= np.swapaxes(coriolis, -1, -2)
    drag = (np.array(VESSEL.linear_drag) + np.array(VESSEL.quadratic_drag) * np.abs(nu)) * nu
    force = -np.einsum("...ij,...j->...i", coriolis, nu) - drag
    expected = np.concatenate(
        [np.einsum("...ij,...j->...i", rotation(x[..., 2]), nu), force / np.array([m1, m2, m3])], axis=-1
    )
    np.testing.assert_allclose(VESSEL.drift(np.zeros((50, 1)), x), expected, rtol=1e-13, atol=1e-14)


def test_the_unicycles_velocity_is_along_its_heading():
    x, u = RNG.normal(size=(50, 4, 3)) * 3.0, RNG.normal(size=(50, 4, 2))
    expected = np.stack([u[..., 0] * np.cos(x[..., 2]), u[..., 0] * np.sin(x[..., 2]), u[..., 1]], axis=-1)
    np.testing.assert_allclose(Unicycle().input_map(np.zeros((50, 1)), x, u), expected, rtol=1e-14, atol=1e-15)


def test_a_unicycles_point_ahead_moves_as_commanded():
    """Within the limits, the point 0.3 m ahead of the axle has the commanded velocity."""
    x, velocity = RNG.normal(size=(50, 4, 3)) * 3.0, RNG.uniform(-0.3, 0.3, (50, 4, 2))
    rate = Unicycle().input_map(np.zeros((50, 1)), x, velocity_to_input(Unicycle(), x, velocity))
    ahead = 0.3 * rate[..., 2:] * np.stack([-np.sin(x[..., 2]), np.cos(x[..., 2])], axis=-1)
    np.testing.assert_allclose(rate[..., :2] + ahead, velocity, atol=1e-14)


def test_a_vessels_velocity_error_decays():
    """Without drag its acceleration in earth axes would be 2 / s times the velocity error, within the limits."""
    x = RNG.uniform(-0.01, 0.01, (50, 4, 6))
    velocity = RNG.uniform(-0.005, 0.005, (50, 4, 2))
    u = velocity_to_input(VESSEL, x, velocity)
    assert np.all(np.abs(u) < VESSEL.input_limit)
    wanted = np.einsum("...ji,...j->...i", rotation(x[..., 2])[..., :2, :2], velocity)
    error = np.concatenate([wanted, np.zeros((50, 4, 1))], axis=-1) - x[..., 3:]
    np.testing.assert_allclose(u / np.array(VESSEL.mass), 2.0 * error, atol=1e-14)


@pytest.mark.parametrize("batch", [1, 3, 70])
def test_a_fleet_in_ranges_is_its_models_one_by_one(batch):
    """Bit for bit, agents of all kinds in runs of several, and nothing outside the range is written."""
    models = [DriftingIntegrator()] * 3 + [SingleIntegrator(), DoubleIntegrator(0.7), Unicycle(), Unicycle()]
    models += [VESSEL, SurfaceVessel(), DoubleIntegrator(0.2), DriftingIntegrator()]
    fleet = Fleet(models)
    x, u = RNG.normal(size=(fleet.n, batch)), RNG.normal(size=(fleet.m, batch))
    for kernel, arguments in ((drifts, (x,)), (input_maps, (x, u))):
        out = np.full((fleet.n, batch), np.nan)
        for low, high in ((0, batch // 2), (batch // 2, batch - 1)):
            kernel(fleet.runs, *arguments, out, low, high)
        assert np.isnan(out[:, max(batch - 1, 0) :]).all()
        kernel(fleet.runs, *arguments, out, max(batch - 1, 0), batch)
        for i, model in enumerate(models):
            own, inputs = x[fleet.state_slice(i)].T, u[fleet.input_slice(i)].T
            t = np.zeros(batch)
            alone = model.drift(t, own) if kernel is drifts else model.input_map(t, own, inputs)
            np.testing.assert_array_equal(out[fleet.state_slice(i)].T, alone)


def test_a_subclass_has_no_compiled_form_but_one_of_its_own():
    class Heavier(SurfaceVessel):
        """It may override anything."""

    heavier = Heavier(mass=(50.0, 60.0, 5.0))
    assert heavier.form is None
    assert Fleet([SurfaceVessel(), heavier]).runs is None
    x = RNG.normal(size=(5, 2, 6))
    same = SurfaceVessel(mass=(50.0, 60.0, 5.0))
    np.testing.assert_array_equal(heavier.drift(np.zeros((5, 1)), x), same.drift(np.zeros((5, 1)), x))
    np.testing.assert_array_equal(velocity_to_input(heavier, x, x[..., :2]), velocity_to_input(same, x, x[..., :2]))
