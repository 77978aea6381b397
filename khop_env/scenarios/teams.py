"""Teams of equal agents that move among each other: common to the scenarios for navigation."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable

import networkx as nx
import numpy as np

from khop_env.network import Network
from khop_env.observers import Exponential, TargetObservers
from khop_env.physics import (
    AgentModel,
    DoubleIntegrator,
    DriftingIntegrator,
    SingleIntegrator,
    Sinusoid,
    SurfaceVessel,
    Unicycle,
    did_you_mean,
    paper_tree,
)
from khop_env.scenarios.scenario import LawChoice, Scenario
from khop_env.simulation import Arena

MOST_LINKS = 3  # of an agent in a random tree


TEAM_MODELS: dict[str, Callable[[float], AgentModel]] = {
    "integrator": lambda speed: SingleIntegrator(input_limit=speed),
    "drifter": lambda speed: DriftingIntegrator(input_limit=1.0 + speed),  # the drift is up to 1 m/s
    "cart": lambda speed: DoubleIntegrator(damping=2.0 / speed, input_limit=2.0),
    "unicycle": lambda speed: Unicycle(input_limit=(speed, 2.0)),
    "vessel": lambda speed: SurfaceVessel(
        linear_drag=(30.0 / speed, 40.0 / speed, 5.0), quadratic_drag=(0.0, 0.0, 0.0), input_limit=(30.0, 40.0, 5.0)
    ),
}
"""By name: agents that move at most at a speed in m/s along each axis."""

# States that are disturbed; else all. Wheels don't slip: what pushed a unicycle sideways, no input could undo.
_PUSHED = {"cart": (0, 0, 1, 1), "unicycle": (0, 0, 1), "vessel": (0, 0, 0, 1, 1, 0)}
_REST = {"cart": (0.0, 0.0), "unicycle": (math.pi,), "vessel": (math.pi, 0.0, 0.0, 0.0)}  # half widths beside positions


def team(
    name: str,
    description: str,
    center: np.ndarray,
    half_width: np.ndarray,
    arena: Arena,
    *,
    speed: float,
    model: str,
    graph: str,
    disturbance: float,
    loss: float,
    burst: float,
    continuous: bool,
    duration: float,
    seed: int,
) -> Scenario:
    """A scenario of equal agents in boxes about `center` (N, 2), `half_width` (N, 2), in m, for navigation.

    All agents know of each other: k is the diameter of the communication graph.

    Raises:
        ValueError: for an unknown model or graph, or numbers out of range.
    """
    if model not in TEAM_MODELS:
        raise ValueError(f"{name}: no model {model!r}; {did_you_mean(model, TEAM_MODELS)}")
    if not 0.0 < speed < math.inf or not 0.0 <= disturbance < math.inf:
        raise ValueError(
            f"{name}: speed must be positive, disturbance not negative, and both finite; got speed={speed:g} and "
            f"disturbance={disturbance:g}"
        )
    agents = len(center)
    agent = TEAM_MODELS[model](speed)
    communication = _graph(name, graph, agents, seed)
    k = max(2, nx.diameter(communication))
    rest = np.tile(_REST.get(model, ()), (agents, 1))
    amplitude = disturbance * np.array(_PUSHED.get(model, (1,) * agent.n), dtype=float)
    return Scenario(
        name=name,
        description=description,
        models=(agent,) * agents,
        communication=communication,
        task=communication,
        k=k,
        delta=Exponential(1.0, 0.117, 5.0),
        observers=(TargetObservers(input_observer=False),) * agents,
        disturbance=Sinusoid(tuple(amplitude.tolist()), frequency=(0.5, 2.0)) if disturbance else None,
        center=np.hstack([center, 0.0 * rest]).ravel(),
        radius=np.hstack([half_width, rest]).ravel(),
        arena=arena,
        law=LawChoice("tanh", {"gain": 0.25 * speed}),
        duration=duration,
        dt=0.05,
        network=None if continuous else Network(period=0.05, loss=loss, burst=burst),
        estimator="ppso" if continuous else "relay",
    ).sized()


def named(family: Callable[..., Scenario], parameters: dict[str, object]) -> str:
    """The family's name, with the parameters that differ from its defaults, as `scenario` reads it."""
    defaults = {key: each.default for key, each in inspect.signature(family).parameters.items()}
    changed = ",".join(f"{key}={_text(value)}" for key, value in parameters.items() if value != defaults[key])
    return f"{family.__name__}:{changed}" if changed else family.__name__


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def require_agents(family: str, agents: int, even: bool) -> None:
    """Refuse numbers of agents that aren't possible.

    Raises:
        ValueError: naming the family and the number.
    """
    wanted = "an even number of agents from 4 to 1000" if even else "4 to 1000 agents"
    if isinstance(agents, bool) or not isinstance(agents, int) or not 4 <= agents <= 1000 or (even and agents % 2):
        raise ValueError(f"{family} needs {wanted}; got agents={agents!r}")


def _graph(name: str, kind: str, agents: int, seed: int) -> nx.Graph:
    """A communication graph; the tree of 8 agents is the paper's."""
    rng = np.random.default_rng(seed)
    if kind == "tree":
        if agents == len(paper_tree()):
            return paper_tree()
        tree = nx.Graph()
        tree.add_node(0)
        for i in range(1, agents):
            tree.add_edge(i, int(rng.choice([j for j in tree if tree.degree[j] < MOST_LINKS])))
        return tree
    if kind == "ring":
        return nx.cycle_graph(agents)
    if kind == "regular3":
        if agents % 2:
            raise ValueError(f"{name}: a graph in which all have 3 links needs an even number of agents; got {agents}")
        while True:
            found = nx.random_regular_graph(3, agents, seed=int(rng.integers(2**31)))
            if nx.is_connected(found):
                return found
    raise ValueError(f"{name}: no graph {kind!r}; {did_you_mean(kind, ('tree', 'ring', 'regular3'))}")
