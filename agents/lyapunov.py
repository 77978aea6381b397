"""The set-ISS gain of consensus laws, from V = |e|^2 / 2 with e = Pi x the disagreement of the positions.

docs/theory/set_iss.md has the derivation, term by term.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import networkx as nx
import numpy as np
from numpy.typing import ArrayLike

from khop_env.observers import FloatArray
from khop_env.physics import DriftingIntegrator, SingleIntegrator
from khop_env.scenarios import Scenario


@dataclass(frozen=True)
class ComparisonGain:
    """Comparison equation of V = |e|^2 / 2 for x_i' = f(x_i) + k sum_j phi(p_j + d_ij - p_i) + w_i, connected graph.

    d collects the estimation errors along the directed task edges (i, j) whose j isn't a neighbour of i, and phi is the
    identity or tanh, component by component. Pi annihilates f at the mean, so that e' Pi f <= l |e|^2 for a common f
    with Lipschitz constant l. Without errors the coupling contributes -k sum over edges of s phi(s) with
    s = p_j - p_i; all |s| <= sqrt(2) |e|, where s tanh(s) >= s^2 tanh(r) / r for |s| <= r; and the sum of the s^2 is
    e' L e >= lambda_2 |e|^2. Both phi are 1-Lipschitz, so that by Cauchy and Schwarz the errors add at most
    k sqrt(D) |d| |e|, where D is the largest number of such edges of an agent. Therefore

        |e|' <= -h(|e|) + k sqrt(D) |d| + |Pi w|,   h(b) = k lambda_2 tanh(sqrt(2) b) / sqrt(2) - l b    (tanh)
                                                    h(b) = (k lambda_2 - l) b                          (linear)

    and where h increases, up to `region`, the loop is set-ISS with respect to A = {e = 0}, with the gain
    gamma(s) = h^-1(k sqrt(D) s). This makes the argument sketched in the paper's simulation section, with the same V,
    quantitative. It holds as long as no input saturates: always for tanh commands below the limits, and for linear ones
    while k (sqrt(2) n |e| + sqrt(D) |d|) is below them, where n is the largest degree.

    Attributes:
        coupling: k lambda_2 in 1/s.
        lipschitz: l in 1/s.
        error_weight: k sqrt(D) in 1/s.
        bounded: whether phi is tanh, not the identity.
        most_pull: sqrt(2) k n in 1/s: bound on the commanded speed divided by |e|.
        limit: the smallest input limit in m/s.
    """

    coupling: float
    lipschitz: float
    error_weight: float
    bounded: bool
    most_pull: float = 0.0
    limit: float = math.inf

    def region(self, error: float = 0.0) -> float:
        """The largest |e|, in m, up to which h increases and no input saturates, at errors |d| up to `error` in m."""
        if self.coupling <= self.lipschitz:
            return 0.0
        if self.bounded:
            if self.lipschitz == 0.0:
                return math.inf
            return math.acosh(math.sqrt(self.coupling / self.lipschitz)) / math.sqrt(2.0)
        return max(0.0, (self.limit - self.error_weight * error) / self.most_pull)

    def decrease(self, distance: ArrayLike) -> FloatArray:
        """h(|e|) in m/s, at distances in m."""
        b = np.asarray(distance, dtype=float)
        pull = np.tanh(math.sqrt(2.0) * b) / math.sqrt(2.0) if self.bounded else b
        return np.asarray(self.coupling * pull - self.lipschitz * b)

    def step(
        self, distance: FloatArray, error: FloatArray, dt: float, disturbance: FloatArray | float = 0.0
    ) -> FloatArray:
        """Integrate the comparison equation b' = -h(b) + k sqrt(D) |d| + |Pi w| over `dt` seconds (classical RK4).

        Args:
            distance: (B,) bounds on |e| at the beginning of the step, in m.
            error: (B,) |d| during the step, in m.
            dt: in s.
            disturbance: (B,) or scalar |Pi w| during the step, in m/s.

        Returns:
            (B,) bounds on |e| at the end of the step, in m; inf once the region has been left.
        """
        gone, distance = np.isinf(distance), np.where(np.isinf(distance), 0.0, distance)
        pushed = self.error_weight * error + disturbance
        k1 = pushed - self.decrease(distance)
        k2 = pushed - self.decrease(distance + 0.5 * dt * k1)
        k3 = pushed - self.decrease(distance + 0.5 * dt * k2)
        k4 = pushed - self.decrease(distance + dt * k3)
        after = distance + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        largest = np.array([self.region(float(norm)) for norm in error.flat]).reshape(error.shape)
        return np.where(~gone & (np.maximum(distance, after) <= largest), after, math.inf)

    def ultimate(self, error: float, disturbance: float = 0.0) -> float:
        """Ultimate bound on |e|, h^-1(k sqrt(D) |d| + |Pi w|), in m.

        Args:
            error: bound on |d| in m.
            disturbance: bound on |Pi w| in m/s.

        Returns:
            inf if error, disturbance or drift are too large for a bound to exist.
        """
        pushed, low, high = self.error_weight * error + disturbance, 0.0, self.region(error)
        if high <= 0.0:
            return math.inf
        if pushed == 0.0:
            return 0.0
        if math.isinf(high):
            if pushed >= self.coupling / math.sqrt(2.0):
                return math.inf
            high = 1.0
            while self.decrease(high) < pushed:
                high *= 2.0
        elif self.decrease(high) <= pushed:
            return math.inf
        for _ in range(200):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.decrease(middle) < pushed else (low, middle)
        return high


_COMMON_DRIFT = (SingleIntegrator, DriftingIntegrator)  # their drift has no parameters


def consensus_gain(scenario: Scenario, gain: float, *, bounded: bool) -> ComparisonGain | None:
    """The comparison equation of a consensus law on a scenario, if it can be derived.

    Args:
        scenario: provides the fleet and the graphs.
        gain: k of the law, in 1/s.
        bounded: whether the law takes tanh of the displacements.

    Returns:
        None unless all agents are single integrators or all are drifting integrators (x' = f(x) + u with a common f)
        and the task graph is connected; None also if tanh commands could exceed an input limit.
    """
    fleet, task, models = scenario.fleet, scenario.task, scenario.fleet.models
    if type(models[0]) not in _COMMON_DRIFT or any(type(model) is not type(models[0]) for model in models):
        return None
    if len(models) < 2 or not nx.is_connected(task):
        return None
    degree, limit = max(count for _, count in task.degree), float(fleet.input_limit.min())
    if bounded and gain * degree > limit:
        return None
    adjacency = nx.to_numpy_array(task)  # networkx's own Laplacian needs SciPy
    connectivity = float(np.linalg.eigvalsh(np.diag(adjacency.sum(axis=0)) - adjacency)[1])
    estimated = max(sum(not scenario.communication.has_edge(j, i) for j in task[i]) for i in range(len(fleet)))
    return ComparisonGain(
        coupling=gain * connectivity,
        lipschitz=models[0].drift_lipschitz(),
        error_weight=gain * math.sqrt(estimated),
        bounded=bounded,
        most_pull=math.sqrt(2.0) * gain * degree,
        limit=limit,
    )
