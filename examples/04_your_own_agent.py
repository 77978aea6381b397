"""Write your own agent model and scenario: pendulums that agree on an angle with k-hop targets."""

import networkx as nx
import numpy as np

from agents import make_law
from khop_env.observers import Exponential
from khop_env.physics import VELOCITY_CONTROLLERS, AgentModel, Sinusoid
from khop_env.scenarios import Scenario


class Pendulum(AgentModel):
    type = "pendulum"
    states = {"angle": "rad", "rate": "rad/s"}  # noqa: RUF012
    inputs = {"torque": "rad/s^2"}  # noqa: RUF012
    position = ("angle",)
    input_limit = 8.0

    def drift(self, t, x):
        return np.stack([x[..., 1], -np.sin(x[..., 0])], axis=-1)

    def input_map(self, t, x, u):
        return np.stack([0.0 * u[..., 0], u[..., 0]], axis=-1)


def swing(model, x, velocity):
    """Follow a commanded angular velocity, gravity cancelled."""
    return np.sin(x[..., :1]) + 4.0 * (velocity - x[..., 1:])


VELOCITY_CONTROLLERS["pendulum"] = swing
scenario = Scenario(
    name="pendulums",
    description="six pendulums in a row; each agrees with its 2-hop targets",
    models=(Pendulum(),) * 6,
    communication=nx.path_graph(6),
    task=nx.Graph([(0, 1), *((i, i + 2) for i in range(4))]),
    k=2,
    delta=Exponential(1.0, 0.05, 5.0),
    theta=Exponential(1.0, 0.5, 5.0),
    disturbance=Sinusoid((0.0, 0.2)),
    radius=np.tile([1.0, 0.2], 6),
).sized()

simulator = scenario.build(law=make_law("tanh"))
print("   t   angles (rad)")
for second in range(9):
    print(f"{second:4d}  ", simulator.fleet.positions(simulator.x)[0, :, 0].round(2))
    for _ in range(100):
        simulator.step(scenario.dt)
print(f"largest |xi| / rho: {simulator.extremes.normalized.max():.3f} (below 1: every estimate kept its bound)")
