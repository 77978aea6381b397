"""Certified bounds of nodes: no adversary gets out of them, and what clocks and rounding add is in them."""

import networkx as nx
import numpy as np
import pytest

from khop_env.network import Network
from khop_env.observers import Certificate, ObserverNode, predict
from khop_env.physics import DoubleIntegrator, DriftingIntegrator, Fleet, SingleIntegrator, SurfaceVessel, Unicycle
from tests.observers.node_rounds import Rounds, T, design_of

MODELS = [SingleIntegrator(2, 2.0), DriftingIntegrator(2.0), DoubleIntegrator(0.7, 2.0), Unicycle(), SurfaceVessel()]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.type)
@pytest.mark.parametrize(
    ("estimator", "dtype"), [("relay", "float64"), ("ppso", "float64"), ("relay", "float16"), ("ppso", "float32")]
)
def test_no_error_exceeds_its_certified_bound(model, estimator, dtype) -> None:
    """Inputs and disturbances at their limits: constant, switching, and away from what others predict."""
    rng = np.random.default_rng(0)
    design = design_of([model] * 4, 3, relay=False, graph=nx.DiGraph([(0, 1), (1, 2), (2, 3), (3, 2), (3, 0)]))
    fleet, substeps = design.fleet, 10
    center, radius = rng.uniform(-0.5, 0.5, fleet.n), rng.uniform(0.0, 0.5, fleet.n)
    disturbance = rng.uniform(0.0, 0.2, fleet.n)
    network = Network(T, loss=0.5, burst=2, latency=0.06, jitter=0.05, noise=0.02)
    packed = {"dtype": dtype, "largest": 30.0} if dtype != "float64" else {}
    known = {"center": center, "radius": radius, "disturbance": disturbance}
    rounds = Rounds(design, network, 1, pack=True, estimator=estimator, **known, **packed)
    x = guess = center + radius * rng.choice([-1.0, 1.0], fleet.n)
    push = rng.choice([-1.0, 1.0], fleet.m)
    pairs = tightest = 0
    for step in range(60):
        kind = step // 15
        if step:
            flee = np.sign(x - guess)
            push = np.where(rng.random(fleet.m) < 0.2, -push, push) if kind == 1 else push
            if kind >= 2:
                push = np.concatenate([flee[fleet.state_slice(a)][-model.m :] for a in range(4)])
            u, w = push * fleet.input_limit, disturbance * (flee if kind >= 2 else np.sign(rng.normal(size=fleet.n)))
            for _ in range(substeps):
                x = stepped(fleet, x, u, w, T / substeps)
        t, u = step * T, push * fleet.input_limit
        rounds.update(t, x, u)
        guess = x.copy()
        for found in rounds.estimates(t):
            for target, (estimate, bound, *_) in found.items():
                true = fleet.state_slice(fleet.agent(target))
                error = np.abs(estimate - x[true])
                assert np.isfinite(bound).all()
                assert (error <= bound + 1e-12).all(), (step, target, error, bound)
                guess[true], pairs = estimate, pairs + 1
                tightest = max(tightest, (error / np.maximum(bound, 1e-9)).max())
    assert pairs == 60 * len(design.knowledge.slot)
    assert tightest > 0.9


def stepped(fleet: Fleet, x, u, w, h):
    """A Runge-Kutta step of order 4 of the whole fleet."""

    def rate(x):
        t = np.zeros(1)
        return fleet.drift(t, x[None])[0] + fleet.input_map(t, x[None], u[None])[0] + w

    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))


def test_a_clock_skew_widens_bounds_by_age_and_drift() -> None:
    """Carts that roll at 10 m/s with clocks 0.1 s apart: bounds without the skew are wrong, those with it are not."""
    cart, skew = DoubleIntegrator(0.5, 1.0), 0.1
    design = design_of([cart] * 3)
    offsets, start = np.array([0.0, -0.5 * skew, 0.5 * skew]), np.tile([0.0, 0.0, 10.0, 0.0], 3)
    broken = {}
    for assumed in (0.0, skew):
        nodes = [
            ObserverNode(design, a, estimator="relay", period=0.15, step=T, center=start, radius=0.0, skew=assumed)
            for a in range(3)
        ]
        broken[assumed] = False
        for step in range(2, 40):
            true = step * T
            x = predict(cart, start[:4, None], np.array([true])).state[:, 0]
            clocks = true + offsets
            for clock, node in zip(clocks, nodes, strict=True):
                node.update(clock, x, np.zeros(2))
            for p, a in design.links.index:
                if step % 3 != a:
                    nodes[a].receive(nodes[p].message())
            for clock, node in zip(clocks, nodes, strict=True):
                for estimate, bound, *_ in node.estimates(clock).values():
                    broken[assumed] |= bool((np.abs(estimate - x) > bound + 1e-12).any())
    assert broken == {0.0: True, skew: False}


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.type)
def test_skew_and_rounding_only_widen(model) -> None:
    """The two terms of a skew (docs/theory/certificates.md) are both in it, and rounding counts once a link."""
    design = design_of([model] * 3)
    x = np.full(design.fleet.n, 0.4)
    known = {"period": T, "estimator": "relay", "center": x, "radius": 0.1}
    bounds = {}
    for name, options in (
        ("plain", {}),
        ("skew", {"skew": 0.01}),
        ("float16", {"dtype": "float16", "largest": 1.0}),
    ):
        nodes = [ObserverNode(design, a, **known, **options) for a in range(3)]
        for step in range(3):
            for a, node in enumerate(nodes):
                node.update(step * T, x[design.fleet.state_slice(a)], np.zeros(model.m))
            sent = [node.message() for node in nodes]
            for p, a in design.links.index:
                nodes[a].receive(sent[p])
        bounds[name] = {i: found.bound for i, found in nodes[0].estimates(2 * T).items()}
    near, far = nodes[0].targets
    growth = model.drift_growth(np.full(model.n, 5.0))
    speed = np.abs(model.drift(np.zeros(1), x[None, : model.n]))[0]
    reached = Certificate(model, region=model.operating_region(np.full(model.n, 0.5), np.zeros(model.n)))
    widened = reached.radius(np.array(T + 0.01)) - reached.radius(np.array(T)) + 0.01 * 0.9 * speed
    assert growth is not None
    assert (bounds["skew"][far] - bounds["plain"][far] >= widened - 1e-12).all()
    per_link = 0.5 * 2.0**-10
    assert (bounds["float16"][near] - bounds["plain"][near] >= per_link).all()
    assert (bounds["float16"][far] - bounds["plain"][far] >= 2 * per_link).all()
    assert (bounds["float16"][far] - bounds["plain"][far] <= 3 * per_link).all()
