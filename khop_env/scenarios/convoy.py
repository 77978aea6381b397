"""Eight agents, three of them fast: for leader following, where estimates matter most."""

from __future__ import annotations

import networkx as nx

from khop_env.observers import Exponential, TargetObservers
from khop_env.physics import DriftingIntegrator, Sinusoid, paper_tree
from khop_env.scenarios.paper import TASK_EDGES
from khop_env.scenarios.scenario import LawChoice, Scenario

LEADERS = (0, 3, 6)


def convoy() -> Scenario:
    """Eight drifting integrators on the paper's tree, three of them with twice the input limit of the others.

    The paper's unstable drift and communication tree with k = 3. Five agents have inputs up to 3 m/s and three, made to
    be leaders, up to 6 m/s: at their default speed of 3 m/s (rms) their followers, all two hops away, saturate now and
    then. The bounds fall at 15 1/s instead of the paper's 5 1/s, since acting on estimates differs from acting on true
    states in the initial transient. There are no input observers: a policy's inputs jump, but they are bounded,
    which is enough for the state observer (the paper's remark on omitting it). All numbers are our choice.
    """
    task = nx.Graph()
    task.add_nodes_from(range(8))
    task.add_edges_from(TASK_EDGES)
    return Scenario(
        name="convoy",
        description="8 drifting integrators, 3 of them fast, on the paper's tree, k = 3: for leader following",
        models=tuple(DriftingIntegrator(input_limit=6.0 if i in LEADERS else 3.0) for i in range(8)),
        communication=paper_tree(),
        task=task,
        k=3,
        delta=Exponential(1.0, 0.117, 15.0),
        observers=(TargetObservers(input_observer=False),) * 8,
        disturbance=Sinusoid(0.4, frequency=(0.5, 2.0)),
        radius=1.5,
        law=LawChoice("tanh", {"gain": 0.75}),
    ).sized()
