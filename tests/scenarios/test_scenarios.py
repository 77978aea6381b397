"""The library's scenarios: what each promises, and the sizing of bounds."""

import networkx as nx
import numpy as np
import pytest

from agents import make_law
from khop_env.observers import Exponential, TargetObservers
from khop_env.physics import DriftingIntegrator, Sinusoid, Sum, random_geometric_graph
from khop_env.results import design_report
from khop_env.scenarios import convoy, mixed_fleet, paper, random_geometric
from khop_env.scenarios.files import write_scenario


def spread(simulator):
    """|Pi p| of the positions."""
    p = simulator.fleet.positions(simulator.x)[0]
    return np.linalg.norm(p - p.mean(axis=0))


@pytest.mark.parametrize("make", [convoy, mixed_fleet, paper, random_geometric])
def test_scenarios_are_functions_of_their_package(make):
    assert make().name.partition(":")[0] == make.__name__


def test_paper_has_the_published_numbers():
    scenario = paper()
    assert (len(scenario.fleet), scenario.k, scenario.fleet.n) == (8, 3, 16)
    t = np.linspace(0.0, 3.0, 50)
    np.testing.assert_allclose(scenario.delta(t), 13.96 * np.exp(-5 * t) + 0.117)
    np.testing.assert_allclose(scenario.theta(t), 230 * np.exp(-5 * t) + 1.39)
    layout = scenario.design.states.layout
    agent_4 = 3
    assert layout.blocks[agent_4].observers == 5
    assert layout.eigenvalues[agent_4, 0] == pytest.approx((3 - np.sqrt(5)) / 2)
    # 0.02 / 0.117 and 39.27 / 230, both published, are lambda_min(M_4) / sqrt(5) to their own rounding
    gain = scenario.design.states.gain[2 * agent_4]
    assert gain == pytest.approx(0.02 / 0.117, rel=1e-3)
    assert gain == pytest.approx(39.27 / 230, rel=1e-3)


def test_papers_task_mostly_joins_agents_out_of_earshot():
    scenario = paper()
    to_targets = [edge for edge in scenario.task.edges if not scenario.communication.has_edge(*edge)]
    assert len(to_targets) > len(scenario.task.edges) / 2
    assert nx.is_connected(scenario.task)


@pytest.mark.parametrize("factory", [paper, mixed_fleet, lambda: random_geometric(agents=30)])
def test_estimates_lead_the_team_together_and_keep_their_bounds(factory):
    scenario = factory()
    simulator = scenario.build(law=make_law(scenario.law))
    before = spread(simulator)
    for _ in range(round(scenario.duration / scenario.dt)):
        simulator.step(scenario.dt)
    assert spread(simulator) < 0.25 * before
    for ratio in simulator.extremes:
        assert np.all(ratio < 1.0)


def test_attributes_of_nodes_and_edges_change_nothing():
    """Laws and observers count edges; so do Theorem 4's gain and the assumptions."""
    scenario = paper().replace(disturbance=None)
    graphs = {name: getattr(scenario, name).copy() for name in ("communication", "task")}
    for graph in graphs.values():
        nx.set_edge_attributes(graph, 100.0, "weight")
        nx.set_node_attributes(graph, 7.0, "weight")
        graph.graph["name"] = "heavy"
    heavy = scenario.replace(**graphs)
    law = make_law(scenario.law)
    assert law.set_iss_gain(heavy) == law.set_iss_gain(scenario)
    assert law.set_iss_gain(scenario).coupling == pytest.approx(2.0 * nx.algebraic_connectivity(scenario.task))
    assert design_report(heavy) == design_report(scenario)
    for name in graphs:
        assert not any(attributes for *_, attributes in getattr(heavy, name).edges(data=True))
        assert not any(attributes for _, attributes in getattr(heavy, name).nodes(data=True))


@pytest.mark.parametrize("name", ["communication", "task"])
def test_graphs_that_say_more_than_an_edge_can_are_refused(name):
    loop = nx.Graph(getattr(paper(), name))
    loop.add_edge(3, 3)
    for graph, message in (
        (loop, r"own neighbour; remove the self-loops \(3, 3\)"),
        (nx.MultiGraph(loop), "got a MultiGraph"),
        (nx.DiGraph(loop), "remove the self-loops" if name == "communication" else "got a DiGraph"),
    ):
        with pytest.raises(ValueError, match=f"{name} graph: .*{message}"):
            paper().replace(**{name: graph})


def test_a_scenarios_graphs_cannot_be_changed_behind_its_design():
    with pytest.raises(nx.NetworkXError, match="Frozen graph"):
        paper().task.add_edge(0, 5)


def test_mixed_fleet_is_mixed():
    scenario = mixed_fleet()
    assert len(scenario.fleet) >= 10
    assert len({model.n for model in scenario.models}) >= 3
    assert isinstance(scenario.disturbance, Sum)
    assert {type(term).__name__ for term in scenario.disturbance.terms} == {
        "Sinusoid", "BandLimitedNoise", "Gust", "Coupling",
    }  # fmt: skip
    blind = scenario.build(law=make_law(scenario.law), observe="local")
    seeing = scenario.build(law=make_law(scenario.law))
    for _ in range(1500):
        blind.step(scenario.dt)
        seeing.step(scenario.dt)
    assert spread(seeing) < 0.3 * spread(blind)


def test_random_geometric_is_a_family():
    one, same, other = (random_geometric(agents=25, k=2, seed=seed) for seed in (3, 3, 4))
    assert set(one.communication.edges) == set(same.communication.edges) != set(other.communication.edges)
    assert set(one.task.edges) == set(same.task.edges)
    graph, _ = random_geometric_graph(25, 5.0, np.random.default_rng(3))
    assert set(one.communication.edges) == set(graph.edges)
    assert nx.is_connected(one.communication)
    assert nx.is_connected(one.task)


@pytest.mark.parametrize(("agents", "k"), [(4, 2), (5, 3), (40, 4)])
def test_every_member_of_the_family_is_feasible(agents, k):
    for seed in range(5):
        scenario = random_geometric(agents=agents, k=k, seed=seed)
        simulator = scenario.build(law=make_law(scenario.law))
        simulator.step(0.01)
        assert np.all(simulator.extremes.normalized < 1.0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"agents": 3}, "agents must be at least 4; got agents=3"),
        ({"agents": 99999999999999999999}, "agents must be at most 100000; got agents=99999999999999999999"),
        ({"agents": 10.0}, "agents must be an integer; got 10.0"),
        ({"agents": True}, "agents must be an integer; got True"),
        ({"k": 1}, "k must be at least 2; got k=1"),
        ({"k": 2.5}, "k must be an integer; got 2.5"),
        ({"seed": -1}, "seed must be at least 0; got seed=-1"),
        ({"seed": 10**30}, "seed must be at most"),
        ({"rate": np.nan}, "needs a positive, finite rate; got rate=nan"),
    ],
)
def test_random_geometric_refuses_nonsense_before_it_draws_anything(given, message):
    with pytest.raises(ValueError, match=message):
        random_geometric(**given)


def test_more_environments_than_memory_holds_are_refused():
    with pytest.raises(
        ValueError, match=r"1000000000 environments of 'paper' have .*e\+.* states and estimates; take 5"
    ):
        paper().build(num_envs=10**9)


def test_sizing_starts_the_bounds_a_margin_above_the_smallest_feasible():
    scenario = paper().replace(delta=Exponential(1.0, 0.1, 5.0)).sized(margin=1.5)
    share = scenario.design.states.feasible_at_start(scenario.initial.radius)
    assert share.max() == pytest.approx(1 / 1.5)
    assert (scenario.delta.final, scenario.delta.rate) == (0.1, 5.0)
    with pytest.raises(ValueError, match="margin must exceed 1"):
        scenario.sized(margin=1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"task": nx.Graph([(0, 7), *((i, i + 1) for i in range(7))])},
            r"know nothing of each other.*\(0, 7\) at distance 5",
        ),
        ({"radius": np.ones(5)}, "radius must be one finite number or 16"),
        ({"radius": -1.0}, "radius must not be negative"),
        ({"dt": 0.0}, "dt must be positive"),
        ({"dt": np.inf}, "dt must be positive and finite; got inf"),
        ({"dt": 1e-300}, "dt must be from 1e-09 to 1e.09 s; got 1e-300"),
        ({"duration": 1e300}, "duration must be from .* got 1e.300"),
        ({"duration": 10**400}, "duration must be from"),
        ({"duration": 1e6, "dt": 1e-6}, r"1e\+12 steps, and 1e\+08 are the most; take dt of 0.01 s or more"),
        ({"relay": "false"}, "relay must be True or False; got 'false'"),
        ({"models": DriftingIntegrator()}, r"models must be one AgentModel per agent, .* got DriftingIntegrator"),
        ({"observers": TargetObservers()}, "observers must be None, or one TargetObservers per agent; got Target"),
        ({"disturbance": Sinusoid}, r"a Disturbance, an object and not its class, e\.g\. Sinusoid\(0\.3\); got <class"),
        ({"arena": 0.2}, r"arena must be None or an Arena, .* got 0\.2"),
        ({"law": "tanh"}, r"law must be a LawChoice, .* got 'tanh'"),
        (
            {"observers": (TargetObservers(drift="no"),) * 8},
            "the drift of its observers must be True or False; got 'no'",
        ),
        ({"order": 4}, "order must be 1, 2 or 3; got 4"),
        ({"figure_agent": 8}, "figure_agent must be None or an agent's index from 0 to 7; got 8"),
        ({"figure_agent": True}, "figure_agent must be None or an agent's index from 0 to 7; got True"),
        ({"name": "../../x"}, "name is also a folder's: 1 to 200 characters without '/'; got '../../x'"),
        ({"name": ""}, "1 to 200 characters"),
        ({"name": "n" * 201}, "1 to 200 characters"),
        ({"name": "a\x1b[31mb"}, r"name must not have control characters; got 'a\\x1b\[31mb'"),
        ({"description": "a\x07"}, "description must not have control characters"),
        ({"duration": np.nan}, "duration must be positive and finite; got nan"),
        ({"k": 2.5}, "k must be an integer, a number of hops; got 2.5"),
        ({"communication": nx.path_graph(7)}, "missing 7"),
        ({"delta": {"vesel": Exponential(1, 1, 1)}}, "delta is given for 'vesel'"),
    ],
)
def test_a_scenario_that_does_not_fit_together_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        paper().replace(**changes).design  # noqa: B018


def test_sizing_leaves_alone_what_an_unbounded_input_decides():
    """|g| of the first four agents has no bound: theta keeps its start for them, and is sized for the others."""
    free, limited = DriftingIntegrator(input_limit=np.inf), DriftingIntegrator(input_limit=10.0)
    given = Exponential(2.0, 1.0, 5.0)
    scenario = paper().replace(models=(free,) * 4 + (limited,) * 4, theta=given)
    finite = paper().replace(models=(limited,) * 8, theta=given)
    smallest = finite.design.inputs.smallest_initial_bound(finite.fleet.input_map_bound)
    assert scenario.sized(2.0).theta == Exponential(2.0 * smallest[8:].max(), 1.0, 5.0)
    assert scenario.replace(theta=Exponential(1e6, 1.0, 5.0)).sized().theta.initial == 1e6
    assert scenario.replace(models=(free,) * 8).sized().theta == given
    by_type = scenario.replace(models=(free,) * 8, theta={"drifter": [given, Exponential(3.0, 1.0, 5.0)]}).sized()
    assert [one.initial for one in by_type.theta["drifter"]] == [2.0, 3.0]
    scenario.replace(theta=Exponential(1e6, 1.0, 5.0)).sized().build()


def test_the_papers_bounds_read_as_one_would_write_them():
    assert "initial = 14.077\n" in write_scenario(paper())
    assert "initial = 231.39\n" in write_scenario(paper())
