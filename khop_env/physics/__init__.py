"""Plant models: agent dynamics, disturbances, fleets, and communication graphs.

Agent models f_i and g_i, disturbances w_i, the fleet that joins them into flat batched vectors, and the graphs over
which agents communicate. Right-hand sides are pure functions of (t, x, u); random numbers are drawn once per episode.
"""

from khop_env.physics.agent_model import AgentModel, FloatArray, IndexArray, did_you_mean, or_did_you_mean, read_only
from khop_env.physics.disturbance import AttachedDisturbance, Channels, Disturbance, Sum, Term
from khop_env.physics.disturbances import DISTURBANCES, BandLimitedNoise, Coupling, Gust, Sinusoid
from khop_env.physics.fleet import Fleet, Group
from khop_env.physics.graph import (
    check_task_graph,
    hop_distances,
    hops_from_targets,
    k_hop_neighbors,
    one_way_links,
    paper_tree,
    random_geometric_graph,
    validate_graph,
)
from khop_env.physics.growth import Growth
from khop_env.physics.links import Links
from khop_env.physics.models import (
    MODELS,
    DoubleIntegrator,
    DriftingIntegrator,
    SingleIntegrator,
    SurfaceVessel,
    Unicycle,
)
from khop_env.physics.velocity import VELOCITY_CONTROLLERS, velocity_to_input

__all__ = [
    "DISTURBANCES",
    "MODELS",
    "VELOCITY_CONTROLLERS",
    "AgentModel",
    "AttachedDisturbance",
    "BandLimitedNoise",
    "Channels",
    "Coupling",
    "Disturbance",
    "DoubleIntegrator",
    "DriftingIntegrator",
    "Fleet",
    "FloatArray",
    "Group",
    "Growth",
    "Gust",
    "IndexArray",
    "Links",
    "SingleIntegrator",
    "Sinusoid",
    "Sum",
    "SurfaceVessel",
    "Term",
    "Unicycle",
    "check_task_graph",
    "did_you_mean",
    "hop_distances",
    "hops_from_targets",
    "k_hop_neighbors",
    "one_way_links",
    "or_did_you_mean",
    "paper_tree",
    "random_geometric_graph",
    "read_only",
    "validate_graph",
    "velocity_to_input",
]
