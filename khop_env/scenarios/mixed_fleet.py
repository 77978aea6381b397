"""Twelve agents of four types in one network, with every kind of disturbance."""

from __future__ import annotations

import networkx as nx
import numpy as np

from khop_env.observers import Bound, Exponential
from khop_env.physics import (
    BandLimitedNoise,
    Coupling,
    DoubleIntegrator,
    Gust,
    SingleIntegrator,
    Sinusoid,
    SurfaceVessel,
    Unicycle,
)
from khop_env.scenarios.scenario import LawChoice, Scenario

GAIN = 0.5
SIDE = 4.0  # m: positions start in a square of twice this side


def mixed_fleet() -> Scenario:
    """Three integrators, three carts, three unicycles and three vessels meet, over a ring without equal neighbours.

    Two chords join agents of equal type. Heterogeneous in n_i (2, 4, 3, 6) and m_i. Unicycles have no input
    observer, since their g depends on the heading; their inputs are bounded, which is enough for the state observer
    (the paper's remark on omitting it). The vessels' drift is only locally Lipschitz: limited forces and drag keep
    their velocities bounded. Disturbances are a sinusoid on the integrators, band-limited noise on the carts'
    accelerations, gusts on the vessels, and a bounded coupling that pulls unicycles away from the mean of all. All
    numbers are our choice.
    """
    models = (
        *[SingleIntegrator(input_limit=1.5)] * 3,
        *[DoubleIntegrator(damping=0.5, input_limit=2.0)] * 3,
        *[Unicycle(input_limit=(1.5, 3.0))] * 3,
        *[SurfaceVessel(input_limit=(30.0, 40.0, 5.0))] * 3,
    )
    ring = [0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11]
    communication = nx.Graph([*zip(ring, ring[1:] + ring[:1], strict=True), (0, 1), (4, 5)])
    task = nx.Graph()
    task.add_nodes_from(range(12))
    task.add_edges_from((ring[j], ring[(j + 3) % 12]) for j in range(12))  # three hops away, or fewer by a chord
    task.add_edges_from((ring[j], ring[j + 1]) for j in range(0, 12, 2))
    place = (SIDE, SIDE)
    radii = (place, (*place, 0.2, 0.2), (*place, 1.5), (*place, 1.5, 0.2, 0.2, 0.1))  # of each kind's states
    return Scenario(
        name="mixed_fleet",
        description="12 integrators, carts, unicycles and vessels with all disturbances, k = 3",
        models=models,
        communication=communication,
        task=task,
        k=3,
        delta={
            "integrator": _exponentials(0.1, 0.1),
            "cart": _exponentials(0.1, 0.1, 0.1, 0.1),
            "unicycle": _exponentials(0.1, 0.1, 0.05),
            "vessel": _exponentials(0.1, 0.1, 0.05, 0.1, 0.1, 0.05),
        },
        theta={
            "integrator": _exponentials(0.5, 0.5),
            "cart": _exponentials(*[0.5] * 4),
            "vessel": _exponentials(*[0.5] * 6),
        },
        disturbance=(
            Sinusoid(0.2, frequency=(0.5, 2.0), agents="integrator")
            + BandLimitedNoise((0.0, 0.0, 0.2, 0.2), band=(0.5, 10.0), agents="cart")
            + Gust((0.0, 0.0, 0.0, 0.2, 0.2, 0.1), duration=1.0, period=4.0, agents="vessel")
            + Coupling(0.1, gain=-0.5, agents="unicycle")
        ),
        radius=np.concatenate([np.tile(radius, 3) for radius in radii]),
        law=LawChoice("tanh", {"gain": GAIN}),
        duration=30.0,
    ).sized()


def _exponentials(*final: float) -> Bound:
    """One bound per component with these final values; the initial ones are sized afterwards."""
    return [Exponential(max(1.0, value), value, 5.0) for value in final]
