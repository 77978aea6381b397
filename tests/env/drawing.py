"""A small fleet, its renderer and a scene, for the tests of rendering."""

import networkx as nx
import numpy as np

from khop_env.env.rendering import Renderer
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


def scene(t=0.0, x=(0.0, 0.0, 3.0, 1.0, 1.0, -2.0), offset=0.0, normalized=0.5):
    """Arguments of `frame`: each agent's estimate `offset` metres off in both coordinates."""
    x = np.array(x)
    return t, x, x[design().states.layout.column_source] + offset, normalized
