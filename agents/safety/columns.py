"""Tables of the columns that a safety filter reads, and checks of what its theorem assumes.

docs/theory/safety.md has the theorem, and where each margin comes from.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection
from dataclasses import replace

import numpy as np

from agents.policy import EnvDescription
from agents.safety.moves import Columns
from khop_env.env import ObservationLayout
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import AgentModel, DriftingIntegrator, SingleIntegrator

Margin = str | float
"""Half width of the box round an estimate: "certified" for its certified bounds, "none" for 0, or a number of m."""

DRIFT: dict[type[AgentModel], float] = {SingleIntegrator: 0.0, DriftingIntegrator: 1.0}
"""Agents whose velocity is their input and a drift, with the largest drift in m/s."""

ANNOUNCED = 4  # numbers in a message: the anchor as a share of observations' limit, and two flags

FLOAT32 = 2.0**-24  # relative rounding of an observation or an action


def read_columns(env: EnvDescription, margin: Margin, radius: float | None, announce: bool = False) -> Columns:
    """The tables of the compiled part.

    Args:
        env: the environment.
        margin: round estimates.
        radius: of an agent's body in m; None for what observations say.
        announce: whether agents send their anchors.

    Raises:
        ValueError: if agents, columns or margins don't fit.
    """
    if announce and env.message_size < ANNOUNCED:
        raise ValueError(
            f"announce=True sends {ANNOUNCED} numbers with each message: make the environment with "
            f"message_size={ANNOUNCED} or more, under a network; it has message_size={env.message_size}"
        )
    first_data = env.message_size - ANNOUNCED
    certified = margin == "certified"
    constant = 0.0 if isinstance(margin, str) else margin
    tracking: dict[str, FloatArray] = {}  # largest distance between an agent and its anchor
    for agent, model in env.models.items():
        require_model(agent, model, env.layouts[agent], DRIFT)
        tracking[agent] = tracking_of(agent, env)
    own, ofbodies, first, start = [], [], [0], 0
    pairs: list[tuple[IntArray, FloatArray, IntArray, FloatArray, int, FloatArray, float]] = []
    announced: list[tuple[IntArray, int, float, FloatArray]] = []
    pace = {agent: _pace(model) if announce else np.full(2, math.inf) for agent, model in env.models.items()}
    for agent, layout in env.layouts.items():
        if certified:
            require_all_known(agent, layout, env)
        place = _own(agent, env)
        own.append(
            (start + place, layout.high[place].astype(float), 1.01 * (tracking[agent] + rounding_of(agent, env)))
        )
        ofbodies.append(bodies(agent, env, start, radius))
        for number, slot in enumerate(layout.slots):
            name, other = f"slot{number}", tracking.get(slot.id, np.zeros(2))
            place = layout.columns(f"{name}.position")
            bound, highest = np.full(2, -1), np.full(2, math.inf)
            if certified:
                bound = np.array([layout.index(f"{name}.bound.{axis}") for axis in env.models[slot.id].position])
                bound, highest = start + bound, layout.high[bound].astype(float)
            by_messages = f"{name}.age" in layout.names  # then boxes are right before anything has arrived, too
            valid = -1 if certified and by_messages else start + layout.index(f"{name}.valid")
            widen = constant + other + rounding_of(agent, env)
            apart = float(np.linalg.norm(tracking[agent]) + np.linalg.norm(other))
            pairs.append((start + place, layout.high[place].astype(float), bound, highest, valid, widen, apart))
            if announce:
                data = np.array([layout.index(f"{name}.message.{first_data + c}") for c in range(ANNOUNCED)])
                age = layout.index(f"{name}.age")
                announced.append((start + data, start + age, float(layout.high[age]), pace[slot.id]))
        first.append(len(pairs))
        start += len(layout)
    if not pairs:
        raise ValueError(f"{env.environment} on {env.scenario} has no slots: nobody knows of anybody")
    columns, limits, tracked = map(np.array, zip(*own, strict=True))
    radius_column, obstacle, obstacle_limit = map(np.array, zip(*ofbodies, strict=True))
    position, position_limit, bounds, bound_limit, valid_column, widened, distances = map(
        np.array, zip(*pairs, strict=True)
    )
    if certified:
        warn_of_near_starts(env, distances, radius)
    speed = np.array([env.models[agent].input_limit for agent in env.agents], float)
    anchors, ages, age_limit, pace_of_other = (
        map(np.array, zip(*announced, strict=True))
        if announced
        else (np.zeros((0, ANNOUNCED), np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 2)))
    )
    return Columns(
        columns,
        limits,
        np.array(first),
        position,
        position_limit,
        bounds,
        bound_limit,
        valid_column,
        certified,
        widened,
        radius_column,
        math.nan if radius is None else radius,
        distances,
        obstacle,
        obstacle_limit,
        np.array([rounding_of(agent, env) for agent in env.agents]),
        np.array([np.linalg.norm(tracking[agent]) for agent in env.agents]),
        speed,
        tracked,
        anchors,
        ages,
        age_limit,
        limits[0],
        np.array([pace[agent] for agent in env.agents]),
        pace_of_other,
    )


def warn_of_near_starts(env: EnvDescription, apart: FloatArray, radius: float | None) -> None:
    """Warn where agents may start closer than the theorem assumes, and so may collide.

    Args:
        env: the environment.
        apart: (P,) of `Columns`.
        radius: of an agent's body in m; None for what the description says.
    """
    radius = env.radius if radius is None else radius
    if radius is None or env.apart is None or env.apart >= 2.0 * radius + float(apart.max()):
        return
    warnings.warn(
        f"the safety filter keeps agents {2.0 * radius + float(apart.max()):.3g} m apart (bodies of {radius:g} m, and "
        f"what disturbances do in a control period of {env.control_period:g} s), and in {env.scenario} they may start "
        f"{env.apart:.3g} m apart, and then collide: choose a shorter control period or a smaller disturbance, or let "
        "them start farther apart",
        stacklevel=1,  # this line, so that it is said once
    )


def without_bounds(
    env: EnvDescription, bounds: bool = False, announced: int = 0
) -> tuple[dict[str, np.ndarray], EnvDescription]:
    """An environment as it is described without bounds in its observations, and without the filter's data.

    Args:
        env: the environment.
        bounds: True to leave bounds in.
        announced: numbers at the end of messages that are the filter's.

    Returns:
        By agent the columns (D_i,) that are left, and the description; no columns where all are left.
    """
    kept, layouts = {}, {}
    size = env.message_size - announced
    sizes = {agent: count - announced for agent, count in env.action_sizes.items()}
    dropped = {str(c) for c in range(size, env.message_size)}
    longest = max(env.layouts.values(), key=lambda layout: len(layout.slots)).names
    for agent, layout in env.layouts.items():
        names, padding = layout.names, f"slot{len(layout.slots)}.valid"
        if padding in names:  # columns of padded slots are where others have theirs
            names = (*names[: layout.index(padding)], *longest[layout.index(padding) :])
        kept[agent] = np.array(
            [q for q, name in enumerate(names) if (bounds or not _is_bound(name)) and not _is_data(name, dropped)],
            np.int64,
        )
        layouts[agent] = ObservationLayout(agent, [layout.fields[q] for q in kept[agent]], layout.slots)
    if all(len(kept[agent]) == len(layout) for agent, layout in env.layouts.items()):
        return {}, env
    return kept, replace(env, layouts=layouts, action_sizes=sizes, message_size=size)


def _own(agent: str, env: EnvDescription) -> IntArray:
    """(2,) columns of an agent's own position."""
    return np.array([env.layouts[agent].index(f"own.{axis}") for axis in env.models[agent].position])


def bodies(agent: str, env: EnvDescription, start: int, radius: float | None) -> tuple[int, IntArray, FloatArray]:
    """The column of the bodies' radius, -1 if it is given, (M, 2) those of obstacles' nearest points, and their limits.

    Args:
        agent: the observing agent's id.
        env: the environment.
        start: the agent's first column in the observations of all agents, side by side.
        radius: None for what observations say.

    Raises:
        ValueError: if no radius is given, nor in observations.
    """
    layout = env.layouts[agent]
    names = set(layout.names)
    column = -1
    if radius is None:
        if "radius" not in names:
            raise ValueError(
                f"observations of {env.environment} have no column 'radius', so that it isn't known how large agents "
                "are: give their radius in m, in Python shielded(policy, radius=0.2), on the command line "
                "filter:radius=0.2:POLICY or --shield certified,radius=0.2"
            )
        column = start + layout.index("radius")
    count = len({name.partition(".")[0] for name in names if name.startswith("obstacle")})
    places = np.array([layout.columns(f"obstacle{q}") for q in range(count)], np.int64).reshape(-1, 2)
    return column, start + places, layout.high[places].astype(float)


def rounding_of(agent: str, env: EnvDescription) -> FloatArray:
    """(2,) largest rounding of an agent's own position in observations, in m.

    Args:
        agent: its id.
        env: the environment.
    """
    return FLOAT32 * env.layouts[agent].high[_own(agent, env)].astype(float)


def tracking_of(agent: str, env: EnvDescription) -> FloatArray:
    """(2,) largest distance per axis between an integrator and its anchor, in m.

    Args:
        agent: its id.
        env: the environment.

    Raises:
        ValueError: if its inputs don't suffice to keep it there, or its disturbance isn't known.
    """
    if agent not in env.disturbance:
        raise ValueError(f"the description says nothing of the disturbance of {agent!r}; use agents.describe(env)")
    model, period = env.models[agent], env.control_period
    speed, pushed = np.asarray(model.input_limit, float), np.asarray(env.disturbance[agent], float)
    growth, drift = model.drift_growth(), DRIFT[type(model)]
    assert growth is not None
    reach = (speed + drift + pushed) * period + rounding_of(agent, env)
    pushed = pushed + growth.matrix @ reach  # the drift isn't what it was at the beginning of the period
    found: FloatArray = pushed * period + rounding_of(agent, env) + FLOAT32 * speed * period
    if not (1.01 * (found + rounding_of(agent, env)) + drift * period <= speed * period).all():
        raise ValueError(
            f"{agent!r} can't hold its place: it is pushed at up to {pushed.max() + drift:g} m/s, and its inputs are "
            f"limited to {speed.min():g} m/s: choose a smaller disturbance, or faster agents"
        )
    return found


def _pace(model: AgentModel) -> FloatArray:
    """(2,) fastest that an anchor moves where it is announced, in m/s."""
    pace: FloatArray = np.asarray(model.input_limit, float) + DRIFT[type(model)]
    return pace


def _is_data(name: str, dropped: set[str]) -> bool:
    slot, _, rest = name.partition(".")
    return slot.startswith("slot") and rest.startswith("message.") and rest.removeprefix("message.") in dropped


def _is_bound(name: str) -> bool:
    slot, _, rest = name.partition(".")
    return slot.startswith("slot") and rest.startswith("bound.")


def require_model(
    agent: str, model: AgentModel, layout: ObservationLayout, models: Collection[type[AgentModel]]
) -> None:
    """Refuse agents of other models, or not in the plane, or whose inputs aren't the actions.

    Args:
        agent: its id.
        model: its model.
        layout: of its observations.
        models: that are possible.

    Raises:
        ValueError: naming the agent and what is possible.
    """
    if type(model) not in models or len(model.position) != 2:
        names = ", ".join(f"{each.__name__}({'dim=2' * (each is SingleIntegrator)})" for each in models)
        dim = f" of dimension {model.dim}" if isinstance(model, SingleIntegrator) else ""
        raise ValueError(
            f"the safety filter is for agents in the plane, {names}; {agent!r} is a {type(model).__name__}{dim}"
        )
    if any(name.startswith("own.input") for name in layout.names):
        raise ValueError(
            f"the safety filter needs inputs that are the actions: make the environment with actuator='direct'; the "
            f"inputs of {agent!r} are states"
        )


def require_steps(env: EnvDescription) -> None:
    """Refuse simulators whose steps aren't those that bounds and braking are proven for.

    Args:
        env: the environment.

    Raises:
        ValueError: for a simulator of order 2 without a network.
    """
    if not env.steps:
        raise ValueError(
            "margin='certified' needs a simulator of order 1, or a network: bounds of estimates, and how agents brake, "
            "are proven for its steps only; leave order=2 out, or choose a margin of some metres, without a guarantee"
        )


def require_all_known(agent: str, layout: ObservationLayout, env: EnvDescription) -> None:
    """Refuse what the theorem doesn't cover.

    Args:
        agent: its id.
        layout: of its observations.
        env: the environment.

    Raises:
        ValueError: if others aren't known, or don't run the filter, or without bounds.
    """
    if env.observe == "local":
        raise ValueError(
            "margin='certified' needs observe='estimate' or 'oracle': with 'local' most agents are unknown"
        )
    if layout.slots and not any(_is_bound(name) for name in layout.names):
        raise ValueError("margin='certified' reads certified bounds: make the environment with bounds=True")
    require_steps(env)
    others = {slot.id for slot in layout.slots}
    if strangers := sorted(others - set(env.agents)):
        raise ValueError(
            f"margin='certified' needs everybody to run the filter, and {', '.join(strangers[:4])} doesn't act; choose "
            "a margin of some metres, without a guarantee"
        )
    if unknown := [each for each in env.agents if each != agent and each not in others]:
        raise ValueError(
            f"margin='certified' needs everybody to know of everybody, and {agent!r} doesn't know of "
            f"{', '.join(unknown[:4])}: they are more than k hops away; choose a scenario with a larger k"
        )
