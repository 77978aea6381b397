"""A small fleet, its renderer and a scene, for the tests of rendering."""

import networkx as nx
import numpy as np

from khop_env.env.rendering import Renderer, Scene
from khop_env.observers import Exponential, ObserverDesign
from khop_env.physics import Fleet, SingleIntegrator

DELTA = Exponential(10.0, 0.5, 5.0)
TASK = np.array([[0, 2], [2, 0], [1, 2]])


POINTS = (SingleIntegrator(),) * 3


def design(models=POINTS, graph=None, k=2) -> ObserverDesign:
    """A path on which agents two apart estimate each other."""
    return ObserverDesign(Fleet(models), graph or nx.path_graph(len(models)), k, DELTA, Exponential(5.0, 1.0, 5.0))


def renderer(**options) -> Renderer:
    return Renderer(design(), TASK, **options)


def scene(t=0.0, x=(0.0, 0.0, 3.0, 1.0, 1.0, -2.0), offset=0.0, ratio=0.5) -> Scene:
    """Each agent's estimate `offset` metres off in both coordinates."""
    return scene_of(design(), t, np.array(x), offset, ratio)


def scene_of(observers: ObserverDesign, t: float, x: np.ndarray, offset=0.0, ratio=0.5) -> Scene:
    """Continuous exchange: boxes of each observer's own bound."""
    states = observers.states
    delta = states.delta.evaluate(np.array([t]), np.empty((len(states.bounds), 1)))
    bounds = states.error_bounds(delta, np.empty((states.layout.size, 1)))[:, 0]
    return Scene(t, x, x[states.layout.column_source] + offset, bounds, ratio)
