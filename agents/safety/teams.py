"""Tables of the columns and numbers that the safety filter reads for teams with agents that have to brake."""

from __future__ import annotations

import math

import numpy as np

from agents.policy import EnvDescription
from agents.safety.braking import axis_map, brake_table, track
from agents.safety.columns import (
    FLOAT32,
    Margin,
    bodies,
    require_all_known,
    require_model,
    require_steps,
    rounding_of,
    tracking_of,
    warn_of_near_starts,
)
from agents.safety.ships import ship_axes
from agents.safety.stopping import NUMBERS
from agents.safety.tables import CART, INTEGRATOR, SHIP, SHIP_NUMBERS, UNICYCLE, Team
from khop_env.env import ObservationLayout
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import (
    AgentModel,
    DoubleIntegrator,
    DriftingIntegrator,
    SingleIntegrator,
    SurfaceVessel,
    Unicycle,
)

KINDS: dict[type[AgentModel], int] = {
    SingleIntegrator: INTEGRATOR,
    DriftingIntegrator: INTEGRATOR,
    DoubleIntegrator: CART,
    Unicycle: UNICYCLE,
    SurfaceVessel: SHIP,
}
_COLUMNS: dict[int, tuple[str, ...]] = {
    INTEGRATOR: (),
    CART: ("vx", "vy"),
    UNICYCLE: ("heading.cos", "heading.sin"),
    SHIP: ("heading.cos", "heading.sin", "surge", "sway", "yaw_rate"),
}
_BOUNDS: dict[int, tuple[str, ...]] = {
    INTEGRATOR: (),
    CART: ("vx", "vy"),
    UNICYCLE: (),
    SHIP: ("heading", "", "surge", "sway"),
}
_CONTINUOUS = 64  # Euler steps in a period that stand for a simulator of order 2, where nothing is certified


class _Agent:
    """Numbers of an agent; see `Team`. Without a description, of something that stands where it is."""

    def __init__(self, agent: str = "", env: EnvDescription | None = None, margin: Margin = "none") -> None:
        self.kind, self.limit, self.turning, self.fastest, self.pull = INTEGRATOR, np.zeros(3), 0.0, math.inf, 0.0
        self.rounding, self.speed_rounding, self.within = np.zeros(2), np.zeros(2), np.zeros(2)
        self.error, self.speed_error, self.jump = np.zeros(2), np.zeros(2), np.zeros(2)
        self.axes, self.ship = [np.zeros(NUMBERS)] * 2, np.zeros(SHIP_NUMBERS)
        if env is None:
            return
        model = env.models[agent]
        require_model(agent, model, env.layouts[agent], KINDS)
        if agent not in env.disturbance:
            raise ValueError(f"the description says nothing of the disturbance of {agent!r}; use agents.describe(env)")
        self.kind, self.rounding = KINDS[type(model)], rounding_of(agent, env)
        pushed = np.asarray(env.disturbance[agent], float)
        self.limit[: model.m] = model.input_limit
        if self.kind == INTEGRATOR:
            self.error = self.within = tracking_of(agent, env)
        elif self.kind == UNICYCLE:
            if margin == "certified" and pushed[:2].any():
                raise ValueError(
                    f"margin='certified' needs unicycles that keep their place when they stop, and the disturbance "
                    f"pushes {agent!r} aside, at up to {pushed[:2].max():g} m/s: let it act on the heading only, or "
                    "choose a margin of some metres, without a guarantee"
                )
            self.turning = 1.01 * pushed[2] * env.control_period + 1e-6
            self.jump = env.control_period * (self.limit[0] + pushed[:2]) + self.rounding  # in a period, as observed
        else:
            self._brake(agent, env, margin, pushed)

    @property
    def observed_error(self) -> FloatArray:
        """(4,) largest errors of position and velocity at the beginning of a period, as they are observed."""
        error, rounding = [*(self.error + self.jump), *self.speed_error], [*self.rounding, *self.speed_rounding]
        return 1.01 * (np.array(error) + rounding)

    def _brake(self, agent: str, env: EnvDescription, margin: Margin, pushed: FloatArray) -> None:
        """A cart or a ship: hold it near its anchor, and stop the anchor with what is left of the input."""
        model, steps, layout = env.models[agent], env.steps, env.layouts[agent]
        if margin == "certified":
            require_steps(env)
        steps = steps or _CONTINUOUS
        names = ("own.vx", "own.vy") if self.kind == CART else ("own.surge", "own.sway")
        speeds = np.array([layout.high[layout.index(name)] for name in names], float)
        self.speed_rounding = FLOAT32 * speeds
        accelerations, cause = self.limit[:2], "choose a smaller disturbance, or larger input limits"
        if isinstance(model, SurfaceVessel):
            yaw = float(layout.high[layout.index("own.yaw_rate")])
            rounding = FLOAT32 * max(float(speeds.max()), yaw)
            ship = ship_axes(agent, model, pushed, rounding, env.control_period, steps)
            self.speed_rounding = np.full(
                2, FLOAT32 * (2.0 * float(speeds.max()) + 4.0)
            )  # turned, by a rounded heading
            damping, accelerations, self.limit = ship.damping, np.full(2, ship.acceleration), ship.limit
            pull, cause = ship.pull, ship.cause
            self.ship, self.fastest, pushed, speeds = ship.numbers, ship.speed, ship.pushed, np.full(2, ship.speed)
        else:
            assert isinstance(model, DoubleIntegrator)
            damping, pull = model.damping, float(self.limit.max())
        axis, self.axes = axis_map(damping, env.control_period, steps), []
        for c in range(2):
            limit = float(accelerations[c])
            disturbance = np.array([pushed[c], pushed[2 + c] + FLOAT32 * limit])
            tracking = track(axis, disturbance, np.array([self.rounding[c], self.speed_rounding[c]]), limit)
            strength = limit - 1.01 * tracking.budget
            if not strength > 0.0:
                raise ValueError(
                    f"{agent!r} can't hold its place: against up to {pushed[2 + c]:.3g} m/s^2 it "
                    f"needs {tracking.budget:.3g} m/s^2, and its inputs give {limit:.3g} m/s^2; {cause}"
                )
            self.pull = max(self.pull, 1.01 * (pull + tracking.budget))
            turning = env.control_period if steps > 1 else 0.0
            brake = brake_table(axis, strength, float(speeds.max()))
            last = len(brake.knots) - 1
            numbers = [*axis[:4], *tracking.gains, strength, turning, last, NUMBERS + 2 * (last + 1)]
            self.axes.append(np.concatenate([numbers, *brake]))
            (self.error[c], self.speed_error[c]), self.within[c] = tracking.error, tracking.within
        if self.kind == SHIP:
            ship.require_held(agent, self.speed_error)


_STANDING = _Agent()


def read_team(env: EnvDescription, margin: Margin, radius: float | None) -> Team:
    """The tables of the compiled part.

    Args:
        env: the environment.
        margin: round estimates.
        radius: of an agent's body in m; None for what observations say.

    Raises:
        ValueError: if agents, columns or margins don't fit.
    """
    certified, constant = margin == "certified", 0.0 if isinstance(margin, str) else margin
    numbers = {agent: _Agent(agent, env, margin) for agent in env.models}
    order = {agent: number for number, agent in enumerate(env.models)}
    own, ofbodies, first, start = [], [], [0], 0
    pairs: list[tuple[IntArray, FloatArray, FloatArray, float]] = []
    for agent, layout in env.layouts.items():
        if certified:
            require_all_known(agent, layout, env)
        of = numbers[agent]
        names = [f"own.{name}" for name in (*env.models[agent].position, *_COLUMNS[of.kind])]
        own.append(_look_up(layout, names, start))
        ofbodies.append(bodies(agent, env, start, radius))
        for number, slot in enumerate(layout.slots):
            name, other = f"slot{number}", numbers.get(slot.id, _STANDING)
            names = [f"{name}.position.{axis}" for axis in "xy"] + [f"{name}.{each}" for each in _COLUMNS[other.kind]]
            columns, limits = _look_up(layout, names, start)
            names = []
            if certified:
                names = [f"{name}.bound.{axis}" for axis in env.models[slot.id].position]
                names += [f"{name}.bound.{each}" if each else "" for each in _BOUNDS[other.kind]]
            bounds, bound_limits = _look_up(layout, names, start)
            by_messages = f"{name}.age" in layout.names  # then boxes are right before anything has arrived, too
            valid = -1 if certified and by_messages else start + layout.index(f"{name}.valid")
            age = start + layout.index(f"{name}.age") if certified and by_messages else -1
            columns = np.array([*columns, *bounds, valid, order.get(slot.id, -1), other.kind, age])
            widen = np.array([*(constant + other.error + of.rounding), *other.speed_error, other.fastest, other.pull])
            apart = float(np.linalg.norm(of.within) + np.linalg.norm(other.within))
            pairs.append((columns, np.concatenate([limits, bound_limits]), widen, apart))
        first.append(len(pairs))
        start += len(layout)
    if not pairs:
        raise ValueError(f"{env.environment} on {env.scenario} has no slots: nobody knows of anybody")
    own_columns, own_limits = map(np.array, zip(*own, strict=True))
    radius_column, obstacle, obstacle_limit = map(np.array, zip(*ofbodies, strict=True))
    pair, pair_limit, widened, distances = map(np.array, zip(*pairs, strict=True))
    if certified:
        warn_of_near_starts(env, distances, radius)
    every = list(numbers.values())
    return Team(
        np.array([each.kind for each in every]),
        own_columns,
        own_limits,
        np.array(first),
        pair,
        pair_limit,
        certified,
        widened,
        distances,
        radius_column,
        math.nan if radius is None else radius,
        obstacle,
        obstacle_limit,
        np.array([each.rounding for each in every]),
        np.array([np.linalg.norm(each.within) for each in every]),
        np.array([each.observed_error for each in every]),
        _side_by_side([each.axes for each in every]),
        np.array([each.limit for each in every]),
        np.array([each.turning for each in every]),
        np.array([each.ship for each in every]),
        np.array([each.fastest for each in every]),
    )


def _side_by_side(axes: list[list[FloatArray]]) -> FloatArray:
    """(N, 2, L) rows of different lengths, filled up with zeros."""
    found = np.zeros((len(axes), 2, max(len(row) for rows in axes for row in rows)))
    for number, rows in enumerate(axes):
        for c, row in enumerate(rows):
            found[number, c, : len(row)] = row
    return found


def _look_up(layout: ObservationLayout, names: list[str], start: int) -> tuple[IntArray, FloatArray]:
    """(7,) columns by name, -1 for none, and from where on they may be clipped: never for cosines and sines."""
    columns, limits = np.full(7, -1), np.full(7, math.inf)
    for c, name in enumerate(names):
        if name:
            place = layout.index(name)
            columns[c] = start + place
            if not name.endswith((".cos", ".sin")):
                limits[c] = float(layout.high[place])
    return columns, limits
