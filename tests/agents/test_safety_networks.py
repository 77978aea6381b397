"""What is in certified bounds has to be in them: noise, clocks that differ, links that come and go."""

import networkx as nx
import numpy as np
import pytest

from agents import SafetyFilter, play, shielded
from agents.policies import needs
from benchmarks.safety import RammingPolicy
from khop_env import make_batched
from khop_env.network import Outage, RandomLinks, Range, Switching
from khop_env.observers import ObserverNode
from khop_env.registry import scenario
from tests.agents.ramming import PERIOD, PUSHED, SPEED, Ram, Ramming
from tests.observers.node_rounds import design_of

NOISE = 0.1  # m
SKEW = 0.14  # s


class Narrowed(SafetyFilter):
    """A filter that takes bounds for smaller than they are.

    Args:
        less: by how much, in m.
    """

    def __init__(self, less):
        super().__init__(RammingPolicy())
        self.less = less

    def act(self, observations):
        """Inputs for narrower boxes."""
        changed = {}
        for agent, values in observations.items():
            bounds = [name.split(".")[1:2] == ["bound"] for name in self._env.layouts[agent].names]
            changed[agent] = np.where(bounds, np.maximum(values - np.float32(self.less), 0.0), values)
        return super().act(changed)


@pytest.mark.parametrize(("less", "collides"), [(0.0, False), (NOISE, True)])
def test_noise_of_measurements_is_in_the_bound(less, collides):
    """By as much as it has to be: bounds without it collide."""
    network = f"ideal:loss=0.3,noise={NOISE}"
    env = make_batched("navigation_v0", "swap", num_envs=30, network=network, bounds=True, max_cycles=100)
    found = play(env, Narrowed(less), range(30)).outcomes
    assert found["collision"].any() == collides
    assert (found["min_distance"].min() >= 0.4) == (not collides)
    assert not found["infeasible"].any()


class Clocks(Ramming):
    """Agents that know of each other from nodes with clocks of their own, which send in every third control period.

    Args:
        assumed: bound on the difference of two clocks, in s, that nodes reckon with; it is `SKEW`.

    Attributes:
        excess: largest error less its bound, in m.
    """

    def __init__(self, assumed):
        super().__init__(batch=1)
        self.offsets = np.where(np.arange(self.agents) % 2, 0.5, -0.5) * SKEW
        self.design = design_of([self.model] * self.agents, self.agents - 1, graph=nx.path_graph(self.agents))
        known = {"center": self.x[0].ravel(), "radius": 0.0, "disturbance": PUSHED, "skew": assumed}
        self.nodes = [
            ObserverNode(self.design, i, estimator="relay", period=3 * PERIOD, step=PERIOD, **known)
            for i in range(self.agents)
        ]
        self.u, self.time, self.excess = np.zeros((self.agents, 2)), SKEW, -np.inf

    def observations(self, env):
        """Estimates and bounds by the clock of each agent."""
        for i, node in enumerate(self.nodes):
            node.update(self.time + self.offsets[i], self.x[0, i], self.u[i])
        for sender, receiver in self.design.links.index:
            if round(self.time / PERIOD) % 3 == sender % 3:
                self.nodes[receiver].receive(self.nodes[sender].message())
        found = {}
        for i, (agent, layout) in enumerate(env.layouts.items()):
            known = self.nodes[i].estimates(self.time + self.offsets[i])
            values = {"radius": self.radius, "own.x": self.x[:, i, 0], "own.y": self.x[:, i, 1]}
            for number, slot in enumerate(layout.slots):
                estimate, bound, *_ = known[slot.id]
                values |= {f"slot{number}.valid": 1.0, f"slot{number}.age": 0.0}
                self.excess = max(self.excess, float((np.abs(estimate - self.x[0, slot.agent]) - bound).max()))
                for c, axis in enumerate("xy"):
                    values[f"slot{number}.position.{axis}"] = estimate[c] - self.x[:, i, c]
                    values[f"slot{number}.bound.{axis}"] = bound[c]
            found[agent] = layout.build(values)
        self.time += PERIOD
        return found

    def move(self, actions):
        """As without clocks."""
        self.u = SPEED * np.stack([action[0] for action in actions.values()]).astype(float)
        super().move(actions)


@pytest.mark.parametrize("assumed", [SKEW, 0.0])
def test_clocks_that_differ_are_in_the_bound(assumed):
    """All act at the same instants, and stamp by clocks that differ; bounds that don't reckon with it are wrong.

    (Wrong bounds needn't collide here: of two clocks one is behind, so that one of two agents is too careful.)
    """
    world = Clocks(assumed)
    env, policy = world.description(), SafetyFilter(Ram(world))
    policy.reset(env, [0])
    for _ in range(80):
        world.move(policy.act(world.observations(env)))
        assert not any(infeasible.any() for infeasible in policy.infeasible.values())
    assert (world.excess > 1e-9) == (assumed == 0.0)
    assert world.closest.min() >= 2.0 * world.radius or assumed == 0.0


RING, STAR = nx.cycle_graph(8), nx.star_graph(7)
SCHEDULES = {
    "random": RandomLinks((0.2, 1.0)),
    "range": Range(2.5),
    "outages": Outage(start=(0.0, 2.0), duration=3.0) & Outage(start=(0.0, 4.0), duration=2.0),
    "switching": Switching((RING, STAR, nx.empty_graph(8)), period=2.0),
}


@pytest.mark.parametrize("name", SCHEDULES)
def test_links_that_come_and_go(name):
    """Certified bounds keep apart on each graph; point estimates collide in some of the same episodes."""
    chosen = scenario("swap").replace(schedule=SCHEDULES[name], communication=nx.compose(RING, STAR))
    env = make_batched("navigation_v0", chosen, num_envs=16, network="ideal:loss=0.2", bounds=True, max_cycles=120)
    certified, points = (
        play(env, shielded(RammingPolicy(), margin), range(16)).outcomes for margin in ("certified", "none")
    )
    assert certified["collision"].sum() == 0
    assert 0.4 <= certified["min_distance"].min() < 0.6
    assert not certified["infeasible"].any()
    assert points["collision"].sum() > 0


def test_announced_anchors_are_read():
    """They let more agents through, on the same episodes."""
    arrived = {}
    for announce in (False, True):
        policy = shielded("keep_right", announce=announce)
        arguments = needs(policy).among({"num_envs": 25})
        arrived[announce] = play(make_batched("navigation_v0", "crossing", **arguments), policy, range(25)).outcomes
    assert arrived[True]["success"].mean() > arrived[False]["success"].mean() + 0.1
    assert not arrived[True]["collision"].any()
