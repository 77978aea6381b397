"""Numbers that the compiled loop of the safety filter reads for teams with agents that have to brake."""

from __future__ import annotations

from typing import NamedTuple

from khop_env.observers import FloatArray, IntArray

INTEGRATOR, CART, UNICYCLE, SHIP = range(4)
LEFT_OUT = -1
SHIP_NUMBERS = 12
SLOWING, DRAG, TURNED, MUNK, YAW_KEEP, YAW_GAIN, YAW_RATE = 0, 2, 4, 6, 7, 8, 9  # the first three of surge and sway
SEEN_SPEED, SEEN_YAW_RATE = 10, 11


class Team(NamedTuple):
    """Where the filter reads, per agent (N) and per pair (P) of an agent and one of its slots, pairs sorted by agent.

    Columns of states are those of x, y; and of vx, vy (cart); cos, sin of the heading (unicycle, ship); surge, sway,
    yaw rate (ship); -1 for others.

    Attributes:
        kind: (N,) of the agent.
        own: (N, 7) columns of its state.
        own_limit: (N, 7) values from here on may have been clipped.
        first: (N + 1,) the agent's first pair.
        pair: (P, 18) columns of the other's state (7), positions relative, and of its bounds (7), that of the heading
            in the place of the cosine's and -1 where none is read; of the flag that something is known, -1 where the
            bound says all; the other agent, -1 for one that doesn't act and is taken as standing; its kind; the
            column of the age of what is observed, -1 where nothing from before is kept.
        pair_limit: (P, 14) as `own_limit`.
        unknown_stops: whether an agent of which nothing is known stops this one, instead of being left out.
        widen: (P, 6) half widths that are added to the bounds of position (2) and velocity (2); the other's `fastest`;
            the largest acceleration of its anchor along an axis, in m/s^2.
        apart: (P,) distance that stopping boxes have to keep, less two radii.
        radius: (N,) column of the radius of the agents' bodies; -1 where it is `body`.
        body: radius in m.
        obstacle: (N, M, 2) columns of the vectors to the nearest points of static convex obstacles.
        obstacle_limit: (N, M, 2) as `own_limit`.
        rounding: (N, 2) of observed positions.
        off: (N,) largest distance from the anchor at any time.
        tracking: (N, 4) largest observed errors of position and velocity at the beginning of a period.
        axes: (N, 2, L) of carts and ships, see `stopping_distance`.
        limit: (N, 3) of inputs: m/s, rad/s, and for carts and ships accelerations, the forces over masses.
        turning: (N,) unicycles: largest disturbance of the heading within a period, in rad.
        ship: (N, SHIP_NUMBERS) of ships, see `braking.Ship`.
        fastest: (N,) ships: largest speed of the anchor, in m/s; inf for others.
    """

    kind: IntArray
    own: IntArray
    own_limit: FloatArray
    first: IntArray
    pair: IntArray
    pair_limit: FloatArray
    unknown_stops: bool
    widen: FloatArray
    apart: FloatArray
    radius: IntArray
    body: float
    obstacle: IntArray
    obstacle_limit: FloatArray
    rounding: FloatArray
    off: FloatArray
    tracking: FloatArray
    axes: FloatArray
    limit: FloatArray
    turning: FloatArray
    ship: FloatArray
    fastest: FloatArray
