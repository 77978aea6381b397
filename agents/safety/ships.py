"""Ships as carts: what their turning and drag add to the disturbance. docs/theory/safety.md, "Ships"."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agents.safety.tables import SHIP_NUMBERS
from khop_env.observers import FloatArray
from khop_env.physics import SurfaceVessel

YAW_RATES = (0.3, 0.4, 0.5, 0.6, 0.8, 1.0)  # rad/s: a ship is allowed the smallest of these at which it can be held
ERROR = 0.08  # largest error of a ship's velocity, as a share of its anchor's largest speed


class ShipAxes(NamedTuple):
    """A ship as a cart along the axes of the world.

    Attributes:
        damping: of the anchor, in 1/s.
        acceleration: along each axis that the forces give whatever the heading and the velocity, in m/s^2.
        limit: (3,) forces over masses.
        pushed: (4,) bounds of what disturbs position and velocity along the axes, per second.
        numbers: (SHIP_NUMBERS,) of `Team.ship`.
        speed: largest speed of the anchor, in m/s.
        pull: largest acceleration along any direction beside that of the damping, in m/s^2.
        cause: where `pushed` comes from, and what makes it smaller, in words.
    """

    damping: float
    acceleration: float
    limit: FloatArray
    pushed: FloatArray
    numbers: FloatArray
    speed: float
    pull: float
    cause: str

    def require_held(self, agent: str, speed_error: FloatArray) -> None:
        """Refuse a ship whose velocity may be farther from its anchor's than was supposed.

        Raises:
            ValueError: naming the agent.
        """
        if float(np.hypot(*speed_error)) > ERROR * self.speed:
            raise ValueError(
                f"{agent!r} can't hold its course: disturbances change its velocity by up to {speed_error.max():.2g} "
                f"m/s, more than {100 * ERROR:g} % of its speed limit of {self.speed:.2g} m/s; {self.cause}"
            )


def ship_axes(
    agent: str, model: SurfaceVessel, disturbance: FloatArray, rounding: float, period: float, steps: int
) -> ShipAxes:
    """The numbers of a ship within an operating region: speeds up to that of full force, and yaw rates.

    Args:
        agent: for errors.
        model: the ship.
        disturbance: (6,) bounds on |w|.
        rounding: of observed velocities and yaw rates.
        period: in s.
        steps: Euler steps in a period.

    Raises:
        ValueError: if its moment can't hold the yaw rate, or its forces can't hold the ship.
    """
    why = ""
    for yaw in YAW_RATES:
        found = _within(model, yaw, disturbance, rounding, period, steps)
        if isinstance(found, ShipAxes):
            return found
        why = why or found
    raise ValueError(f"the safety filter can't hold {agent!r}: {why}")


def _within(
    model: SurfaceVessel, yaw: float, disturbance: FloatArray, rounding: float, period: float, steps: int
) -> ShipAxes | str:
    """The numbers for yaw rates up to `yaw`, or why it can't be held."""
    mass, linear, quadratic = (np.array(each) for each in (model.mass, model.linear_drag, model.quadratic_drag))
    limit, (m1, m2, m3) = model.input_limit / mass, mass
    damping, step = float((linear / mass)[:2].min()), period / steps
    anchor = float(_settled(model.input_limit, linear, quadratic)[:2].min())
    if not math.isfinite(anchor):
        return "it has no drag, which would limit its speed"
    speed = (1.0 + ERROR) * anchor
    slowing, drag = (linear / mass)[:2] - damping, (quadratic / mass)[:2]
    turned, munk = (m2 - m1) / mass[:2], (m1 - m2) / m3
    # what the anchor's acceleration holds beside the forces, and how fast that changes with the velocity
    beside = slowing * speed + drag * speed**2 + np.abs(turned) * yaw * speed
    slope = float((slowing + 2.0 * drag * speed).max() + np.abs(turned).max() * yaw)
    # largest rates in the body's frame
    rates = limit[:2] + (linear / mass)[:2] * speed + drag * speed**2 + yaw * speed * np.array([m2 / m1, m1 / m2])
    rate = float(np.hypot(*(rates + disturbance[3:5])))
    yaw_rate = limit[2] + abs(munk) * speed**2 / 2.0 + (linear[2] + quadratic[2] * yaw) / m3 * yaw + disturbance[5]
    span, turning = period - step, yaw + disturbance[2]
    force = float(np.hypot(*(limit[:2] + beside)))
    changed = turning * span * force + slope * rate * span
    changed += float(np.abs(turned).max()) * speed * min(yaw_rate * span, 2.0 * yaw)
    euler = step * turning * (0.5 * turning * speed + rate) + disturbance[2] * speed
    seen = rounding * (slope + 2.0 * float(np.abs(turned).max()) * speed) + 2e-7 * force
    parts = float(np.hypot(*disturbance[3:5])), changed, euler
    along = parts[0] + changed + euler + seen
    acceleration = float((limit[:2] - beside).min()) / math.sqrt(2.0)
    if not acceleration > 0.0:
        return (
            f"at {speed:.2g} m/s drag and turning take up to {beside.max():.2g} m/s^2, and its forces give "
            f"{limit[:2].min():.2g} m/s^2"
        )
    slowed = step * (linear[2] + quadratic[2] * yaw) / m3
    keep = (1.0 - step * linear[2] / m3) ** steps
    gain = sum(step * (1.0 - step * linear[2] / m3) ** k for k in range(steps))
    speeding = abs(munk) * min(speed**2, 1.5 * speed * rate * span)
    swing = speeding + disturbance[5] + quadratic[2] * yaw**2 / m3
    left = yaw - 1.001 * gain * (swing + abs(munk) * 2.0 * speed * rounding) - rounding
    if slowed >= 1.0 or keep * yaw + gain * (abs(munk) * speed**2 / 2.0 - limit[2]) > left:
        why = f"its moment doesn't keep its yaw rate below {yaw:g} rad/s at {speed:.2g} m/s"
        spare = limit[2] + (1.0 - keep) / gain * yaw - abs(munk) * speed**2 / 2.0 - quadratic[2] * yaw**2 / m3
        if slowed >= 1.0 or spare <= 0.0:
            return why
        return f"{why}; {_cause((float(disturbance[5]), speeding, 0.0), 'rad/s^2', disturbance[5], period, steps)}"
    seen_yaw = 1.01 * yaw + rounding
    numbers = np.array([*slowing, *drag, *turned, munk, keep, gain, left, 1.01 * speed + 2.0 * rounding, seen_yaw])
    assert len(numbers) == SHIP_NUMBERS
    pushed = np.array([*disturbance[:2], along, along])
    cause = _cause(parts, "m/s^2", float(disturbance[3:5].max()), period, steps)
    return ShipAxes(damping, acceleration, limit, pushed, numbers, anchor, force, cause)


def _cause(parts: tuple[float, float, float], unit: str, disturbance: float, period: float, steps: int) -> str:
    """What a ship has to be held against, and what makes the largest part smaller."""
    of_disturbance, of_period, of_step = parts
    known = (
        (of_disturbance, f"from disturbances of {disturbance:g}", "choose a smaller disturbance"),
        (of_period, f"from what changes in a control period of {period:.3g} s", "choose a shorter control period"),
        (
            of_step,
            f"from steps of {period / steps:.3g} s",
            "choose a shorter dt" if steps > 1 else "choose a shorter control period",  # dt would shift it there
        ),
    )
    said = ", ".join(f"{part:.2g} {unit} {where}" for part, where, _ in known if part > 0.0)
    return f"it has to be held against {said}: {max(known)[2]}"


def _settled(force: FloatArray, linear: FloatArray, quadratic: FloatArray) -> FloatArray:
    """(3,) speeds at which drag balances a force."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found: FloatArray = 2.0 * force / (linear + np.sqrt(linear**2 + 4.0 * quadratic * force))
    return np.where(np.isfinite(found), found, math.inf)
