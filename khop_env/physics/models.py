"""The library's agent models: frozen parameters, and the right-hand sides of a textbook or of the paper.

Each docstring gives the equation and its source. To write another, subclass AgentModel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from khop_env.physics.agent_model import AgentModel, FloatArray, InputLimit
from khop_env.physics.growth import Growth, energy_region, ship_growth
from khop_env.physics.right_hand_sides import (
    CART,
    DRIFTER,
    INTEGRATOR,
    UNICYCLE,
    VESSEL,
    Form,
    drifts,
    evaluated,
    input_maps,
)


@dataclass(frozen=True, eq=False)
class SingleIntegrator(AgentModel):
    """A point whose velocity is commanded: x' = u, in `dim` dimensions.

    Source: the standard agent of consensus theory, e.g. M. Mesbahi and M. Egerstedt, Graph Theoretic Methods in
    Multiagent Networks, 2010, chapter 3.
    """

    dim: int = 2
    input_limit: InputLimit = 1.0  # m/s

    type = "integrator"

    def __post_init__(self) -> None:
        if isinstance(self.dim, bool) or self.dim not in (1, 2, 3) or not isinstance(self.dim, int | np.integer):
            raise ValueError(f"SingleIntegrator.dim must be 1, 2 or 3; got {self.dim!r}")
        super().__post_init__()

    @property
    def states(self) -> Mapping[str, str]:  # type: ignore[override]
        """Coordinates, in m."""
        return dict.fromkeys("xyz"[: self.dim], "m")

    @property
    def inputs(self) -> Mapping[str, str]:  # type: ignore[override]
        """Velocities, in m/s."""
        return {f"v{axis}": "m/s" for axis in self.states}

    @property
    def position(self) -> tuple[str, ...]:  # type: ignore[override]
        """All coordinates."""
        return tuple(self.states)

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its right-hand sides, compiled."""
        return Form(INTEGRATOR)

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """Drift f = 0."""
        return np.zeros_like(x)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Input map g = u."""
        return u

    def drift_lipschitz(self) -> float:
        """Zero: there is no drift."""
        return 0.0

    def drift_growth(self, region: FloatArray | None = None) -> Growth:
        """Two solutions of f = 0 don't part, in any `region`: Lambda = 0."""
        return Growth(np.zeros((self.n, self.n)), spread=np.zeros(self.n))


@dataclass(frozen=True, eq=False)
class DriftingIntegrator(AgentModel):
    """The agent of the paper's simulation section: x' = f(x) + u.

        f(x) = [tanh(x1 / 2 + x2 / 2), sin(x1 / 2 - x2 / 2)]

    |f| is at most 1 in each component, so an input limit above 1 m/s can overcome it.
    """

    input_limit: InputLimit = 10.0  # m/s

    type = "drifter"
    states = MappingProxyType({"x1": "m", "x2": "m"})
    inputs = MappingProxyType({"u1": "m/s", "u2": "m/s"})
    position = ("x1", "x2")

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its right-hand sides, compiled."""
        return Form(DRIFTER)

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """The f of the paper's simulation section, compiled."""
        return evaluated(drifts, Form(DRIFTER), 2, x)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Input map g = u."""
        return u

    def drift_lipschitz(self) -> float:
        """The paper's l_f = 1 (the smallest constant is 1 / sqrt(2))."""
        return 1.0

    def drift_growth(self, region: FloatArray | None = None) -> Growth:
        """Lambda = 1/2 in all entries, in any `region`.

        tanh((x1 + x2) / 2) has both derivatives sech^2 / 2 in (0, 1/2]; sin((x1 - x2) / 2) has cos / 2 and -cos / 2,
        within +-1/2. Both values are within +-1, so that they differ by 2 at most.
        """
        return Growth(np.full((2, 2), 0.5), spread=np.full(2, 2.0), step=1.0 / 16.0)


@dataclass(frozen=True, eq=False)
class DoubleIntegrator(AgentModel):
    """A cart in the plane whose acceleration is commanded: p' = v, v' = -damping v + u; damping in 1/s.

    Source: W. Ren and R. W. Beard, Distributed Consensus in Multi-vehicle Cooperative Control, 2008, chapter 4.
    """

    damping: float = 0.5
    input_limit: InputLimit = 1.0  # m/s^2

    type = "cart"
    states = MappingProxyType({"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"})
    inputs = MappingProxyType({"ax": "m/s^2", "ay": "m/s^2"})
    position = ("x", "y")

    def __post_init__(self) -> None:
        if not 0.0 <= self.damping < math.inf:
            raise ValueError(f"DoubleIntegrator.damping must be finite and not negative (1/s); got {self.damping!r}")
        super().__post_init__()

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its right-hand sides, compiled."""
        return Form(CART, (float(self.damping),))

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """Drift f = [v, -damping v]."""
        velocity = x[..., 2:]
        return np.concatenate([velocity, -self.damping * velocity], axis=-1)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Input map g = [0, u]."""
        return np.concatenate([np.zeros_like(u), u], axis=-1)

    def drift_lipschitz(self) -> float:
        """The norm of [[0, 1], [0, -damping]]."""
        return math.hypot(1.0, self.damping)

    def drift_growth(self, region: FloatArray | None = None) -> Growth:
        """The drift is linear, f = Lambda x with Lambda = [[0, I], [0, -damping I]], in any `region`."""
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 2)), -self.damping * np.eye(2)]])
        return Growth(matrix, step=1.0 / 16.0 / self.damping if self.damping > 0.0 else math.inf)

    def explicit_step(self, reach: FloatArray, disturbance: FloatArray) -> float:
        """The time constant 1 / damping: up to it a step of either order never turns a velocity round."""
        return 1.0 / self.damping if self.damping > 0.0 else math.inf


@dataclass(frozen=True, eq=False)
class Unicycle(AgentModel):
    """A wheeled robot: x' = v cos(heading), y' = v sin(heading), heading' = omega; inputs v and omega.

    g depends on the state and is bounded, the extension that the paper's remark after Assumption 2 allows for the
    state observer. Headings are not wrapped. Source: K. M. Lynch and F. C. Park, Modern Robotics, 2017, section 13.3.
    """

    input_limit: InputLimit = (1.0, 2.0)  # m/s, rad/s

    type = "unicycle"
    states = MappingProxyType({"x": "m", "y": "m", "heading": "rad"})
    inputs = MappingProxyType({"speed": "m/s", "turn_rate": "rad/s"})
    position = ("x", "y")
    input_map_uses_state = True

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its right-hand sides, compiled."""
        return Form(UNICYCLE)

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """Drift f = 0."""
        return np.zeros_like(x)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Input map g = [v cos(heading), v sin(heading), omega]."""
        return evaluated(input_maps, Form(UNICYCLE), 3, x, u)

    def input_map_bound(self) -> FloatArray:
        """Exact over all headings: [v, v, omega] at their limits."""
        return self.input_limit[[0, 0, 1]]

    def drift_lipschitz(self) -> float:
        """Zero: there is no drift."""
        return 0.0

    def drift_growth(self, region: FloatArray | None = None) -> Growth:
        """Two solutions of f = 0 don't part, in any `region`: Lambda = 0."""
        return Growth(np.zeros((self.n, self.n)), spread=np.zeros(self.n))


@dataclass(frozen=True, eq=False)
class SurfaceVessel(AgentModel):
    """A ship in the plane with 3 degrees of freedom: pose eta = (x, y, heading), body velocity nu = (u, v, r).

        eta' = R(heading) nu
        M nu' + C(nu) nu + D(nu) nu = tau

    M = diag(mass) includes the added mass, C(nu) nu = [-m2 v r, m1 u r, (m2 - m1) u v] does no work, and
    D(nu) = diag(linear_drag + quadratic_drag |nu|). The inputs are tau: two forces and a moment, so the vessel is
    fully actuated. The drift is only locally Lipschitz (Coriolis terms and quadratic drag), while the observers'
    theorems need a constant: keep the states in a bounded operating region. Headings are not wrapped.

    Source: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011, chapters 6 and 7. The default
    values are those of the model ship CyberShip II, rounded (R. Skjetne, O. N. Smogeli and T. I. Fossen, Modeling,
    Identification and Control 25(1), 2004), with three simplifications: no coupling of sway and yaw in M and D,
    no cubic drag, and input limits of our choice.
    """

    mass: tuple[float, float, float] = (25.8, 33.8, 2.76)  # kg, kg, kg m^2
    linear_drag: tuple[float, float, float] = (0.72, 0.86, 1.9)  # kg/s, kg/s, kg m^2/s
    quadratic_drag: tuple[float, float, float] = (1.33, 36.3, 0.75)  # kg/m, kg/m, kg m^2
    input_limit: InputLimit = (2.0, 1.5, 1.5)  # N, N, N m

    type = "vessel"
    states = MappingProxyType(
        {"x": "m", "y": "m", "heading": "rad", "surge": "m/s", "sway": "m/s", "yaw_rate": "rad/s"}
    )
    inputs = MappingProxyType({"surge_force": "N", "sway_force": "N", "yaw_moment": "N m"})
    position = ("x", "y")

    def __post_init__(self) -> None:
        for name in ("mass", "linear_drag", "quadratic_drag"):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != 3 or not all(0 <= v < math.inf for v in values) or (name == "mass" and 0 in values):
                sign = "positive" if name == "mass" else "non-negative"
                raise ValueError(
                    f"SurfaceVessel.{name} must be three {sign}, finite numbers (surge, sway, yaw); got {values}"
                )
            object.__setattr__(self, name, values)
        super().__post_init__()

    @property
    def form(self) -> Form:  # type: ignore[override]
        """Its right-hand sides, compiled."""
        return vessel_form(self)

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """Drift f = [R(heading) nu, -M^-1 (C(nu) nu + D(nu) nu)]."""
        return evaluated(drifts, vessel_form(self), 6, x)

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Input map g = [0, M^-1 tau]."""
        return np.concatenate([np.zeros_like(u), u / np.array(self.mass)], axis=-1)

    def drift_lipschitz(self) -> float:
        """Infinite: the drift is quadratic in the velocities."""
        return math.inf

    def drift_growth(self, region: FloatArray | None = None) -> Growth | None:
        """`growth.ship_growth` of the velocities within `region`; None without bounds on all three."""
        region = np.full(6, math.inf) if region is None else region
        mass, linear, quadratic = (np.array(v) for v in (self.mass, self.linear_drag, self.quadratic_drag))
        return ship_growth(mass, linear, quadratic, region)

    def operating_region(self, reach: FloatArray, disturbance: FloatArray) -> FloatArray:
        """Velocities at which drag takes more than full force can give (`growth.energy_region`); any pose."""
        mass, linear, quadratic = (np.array(v) for v in (self.mass, self.linear_drag, self.quadratic_drag))
        force = self.input_limit + mass * disturbance[3:]
        velocities = energy_region(mass, linear, quadratic, force, reach[3:])
        return np.concatenate([np.full(3, math.inf), velocities])

    def explicit_step(self, reach: FloatArray, disturbance: FloatArray) -> float:
        """0.9 / (drag + turning), in s, at the larger of the initial velocities and those at full force.

        At full input and disturbance the velocity settles where drag balances them. Drag, in 1/s, is the largest slope
        of M^-1 D(nu) nu there; turning is the norm of the skew matrix M^-1/2 C(nu) M^-1/2, which turns the momentum
        without changing the energy. An explicit step adds energy as it turns, and is unstable where it adds more than
        drag removes. The factor is measured: no vessel of a ship's proportions diverged under random, held or
        energy-raising inputs at their limits. Without drag and input limits, the initial velocities count.
        """
        mass, linear, quadratic = (np.array(v) for v in (self.mass, self.linear_drag, self.quadratic_drag))
        force = self.input_limit + mass * disturbance[3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            settled = 2.0 * force / (linear + np.sqrt(linear**2 + 4.0 * quadratic * force))
        speed = np.maximum(reach[3:], np.where(np.isfinite(settled), settled, 0.0))
        (surge, sway, _), (m1, m2, m3) = speed, mass
        turning = math.hypot(m2 * sway / math.sqrt(m1 * m3), m1 * surge / math.sqrt(m2 * m3))
        rate = float(((linear + 2.0 * quadratic * speed) / mass).max()) + turning
        return 0.9 / rate if rate > 0.0 else math.inf


def vessel_form(model: SurfaceVessel) -> Form:
    """The compiled form of a surface vessel, also of a subclass whose own drift goes beyond it."""
    return Form(VESSEL, (*model.mass, *model.linear_drag, *model.quadratic_drag))


MODELS: dict[str, type[AgentModel]] = {
    model.type: model for model in (SingleIntegrator, DriftingIntegrator, DoubleIntegrator, Unicycle, SurfaceVessel)
}
"""Agent models by `type`, as scenario files name them."""
