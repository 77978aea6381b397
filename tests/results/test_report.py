import json
import math
import re

import networkx as nx
import numpy as np
import pytest

from agents import make_law
from khop_env.observers import DesignError, Exponential, TargetObservers
from khop_env.physics import (
    AgentModel,
    Coupling,
    DoubleIntegrator,
    Gust,
    SingleIntegrator,
    Sinusoid,
    Sum,
    Term,
    Unicycle,
)
from khop_env.results import design_report
from khop_env.scenarios import LawChoice, Scenario, paper
from khop_env.scenarios.mixed_fleet import mixed_fleet
from khop_env.scenarios.random_geometric import random_geometric


def path_of(agents: int = 4, **changes) -> Scenario:
    graph = nx.path_graph(agents)
    values = {
        "name": "path",
        "description": "",
        "models": (SingleIntegrator(input_limit=4.0),) * agents,
        "communication": graph,
        "task": graph,
        "k": 2,
        "delta": Exponential(10.0, 0.1, 5.0),
        "theta": Exponential(100.0, 1.0, 5.0),
    }
    return Scenario(**(values | changes))


def assumption(report, number: str):
    (found,) = [entry for entry in report["assumptions"] if entry["number"] == number]
    return found


@pytest.mark.parametrize("make", [paper, mixed_fleet, random_geometric])
def test_every_scenario_is_feasible_and_plain_json(make):
    report = design_report(make())
    assert report["feasible"] is True
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert [entry["number"] for entry in report["assumptions"]] == ["1-i", "1-ii", "1-iii", "2", "3", "4", "5", "6"]
    assert all(entry["why"] for entry in report["assumptions"])


def test_agent_4_of_the_paper():
    """lambda_min = (3 - sqrt 5) / 2, eta = 5 and rho(inf) = 0.02, omega's decay 39.27: the published constants."""
    report = design_report(paper())
    agent = report["targets"][3]
    assert agent["agent"] == "drifter_3"
    assert agent["k_hop"] == ["drifter_0", "drifter_1", "drifter_5", "drifter_6", "drifter_7"]
    assert agent["eta"] == 5
    assert agent["lambda_min"] == pytest.approx((3.0 - math.sqrt(5.0)) / 2.0)
    (state,), (input_,) = agent["state"], agent["input"]
    assert state["components"] == ["x1", "x2"]
    assert state["delta"] == {"initial": pytest.approx(14.077), "final": 0.117, "rate": 5.0}
    assert state["rho"]["final"] == pytest.approx(0.02, rel=1e-3)
    assert input_["omega"]["initial"] - input_["omega"]["final"] == pytest.approx(39.27, rel=1e-3)
    assert 0.0 < state["start_share"] < 1.0


def test_step_bound_is_the_worst_targets():
    scenario = paper()
    report = design_report(scenario)
    bounds = [0.5 * target["state"][0]["rho"]["final"] ** 2 / target["lambda_max"] for target in report["targets"]]
    assert report["explicit_step_bound_s"]["state"] == pytest.approx(min(bounds))
    assert report["explicit_step_bound_s"]["input"] > report["explicit_step_bound_s"]["state"]


def test_components_with_different_bounds_stay_apart():
    bound = {"integrator": (Exponential(10.0, 0.1, 5.0), Exponential(20.0, 0.2, 5.0))}
    (x, y) = design_report(path_of(delta=bound))["targets"][0]["state"]
    assert (x["components"], y["components"]) == (["x"], ["y"])
    assert y["rho"]["final"] == pytest.approx(2.0 * x["rho"]["final"])
    assert x["start_share"] == pytest.approx(2.0 * y["start_share"])


def test_a_start_outside_the_funnel_is_told_with_the_number_that_would_do():
    report = design_report(path_of(radius=50.0))
    assert report["feasible"] is False
    assert "take delta(0) above" in report["error"]
    assert report["targets"][0]["state"][0]["start_share"] >= 1.0


def test_a_design_that_is_impossible_is_reported_not_raised():
    report = design_report(path_of(theta=None))
    assert report["feasible"] is False
    assert "theta is missing" in report["error"]
    assert report["targets"] == []
    json.dumps(report, allow_nan=False)


def test_unbounded_inputs_can_only_be_checked_at_the_start():
    """As in a simulator (Assumption 2-ii): the report has null, and is feasible."""
    scenario = path_of(models=(SingleIntegrator(input_limit=np.inf),) * 4)
    report = design_report(scenario)
    scenario.build()
    assert report["feasible"] is True
    assert report["error"] is None
    assert report["targets"][0]["input"][0]["start_share"] is None
    json.dumps(report, allow_nan=False)
    wide = design_report(scenario.replace(radius=50.0))
    assert wide["feasible"] is False
    assert "take delta(0) above" in wide["error"]


def test_the_keys_are_the_same_whatever_is_wrong():
    whole, none = design_report(path_of()), design_report(path_of(theta=None))
    assert whole.keys() == none.keys()
    assert whole["explicit_step_bound_s"].keys() == none["explicit_step_bound_s"].keys()
    assert none["pairs"] is none["estimates"] is none["explicit_step_bound_s"]["state"] is None


class Own:
    """max(floor, 10 exp(-t)), with a declared infimum."""

    def __init__(self, floor: float, said: float) -> None:
        self.floor, self.said = floor, said

    def __call__(self, t):
        return np.maximum(self.floor, 10.0 * np.exp(-t))

    def infimum(self) -> float:
        return self.said


def test_a_bound_that_goes_below_its_own_infimum_is_refused():
    report = design_report(path_of(delta=Own(0.1, 1.0)))
    assert report["feasible"] is False
    assert re.search(
        r"delta: .*Own.* is 0\.99\d* at t = 2\.31 s, but its infimum\(\) says .* below 1;", report["error"]
    )
    assert "infimum() must be positive" in design_report(path_of(theta=Own(0.1, 0.0)))["error"]
    assert design_report(path_of(delta=Own(0.1, 0.1)))["feasible"] is True
    with pytest.raises(DesignError, match="Definition 1"):
        path_of(delta=Own(np.nan, 0.1)).build()


class TestFloatingPoint:
    def test_bounds_that_no_number_can_keep_are_refused_with_those_that_can(self):
        """On the paper's tree |e| comes to 8 with delta(inf) = 3e-15 and states of 6 m."""
        scenario = paper()
        report = design_report(scenario.replace(delta=Exponential(14.077, 1e-14, 5.0)))
        assert report["feasible"] is False
        assert re.search(
            r"delta\(inf\) = 1e-14 of 'drifter_\d', component 'x1', is too small for floating", report["error"]
        )
        enough = float(report["error"].rpartition(" ")[2])
        assert 1e-14 < enough < 1e-10
        assert design_report(scenario.replace(delta=Exponential(14.077, enough, 5.0)))["feasible"] is True

    @pytest.mark.parametrize("make", [paper, mixed_fleet, lambda: random_geometric(agents=40, k=4)])
    def test_those_that_are_said_to_be_kept_are_kept(self, make):
        scenario = make()
        lowest = 1e-30
        while True:
            tight = scenario.replace(delta=with_final(scenario.delta, lowest), duration=10.0)
            report = design_report(tight)
            if report["feasible"]:
                break
            assert "delta(inf)" in report["error"]
            lowest = float(report["error"].rpartition(" ")[2])
        simulator = tight.build(law=make_law(tight.law), num_envs=3)
        for _ in range(round(tight.duration / tight.dt)):
            simulator.step(tight.dt)
        assert simulator.extremes.normalized.max() < 1.0
        assert 1e-14 < lowest < 1e-9

    def test_so_are_bounds_on_inputs(self):
        report = design_report(paper().replace(theta=Exponential(231.39, 1e-16, 5.0)))
        assert "theta(inf) = 1e-16 of 'drifter_" in report["error"]
        assert re.search(r"where the input effect on x1 may be \d m/s, omega\(inf\) = ", report["error"])


def with_final(bounds, final: float):
    if isinstance(bounds, Exponential):
        return Exponential(bounds.initial, final, bounds.rate)
    if isinstance(bounds, dict):
        return {kind: with_final(bound, final) for kind, bound in bounds.items()}
    return [with_final(bound, final) for bound in bounds]


def test_a_step_that_the_plants_drift_cannot_take_is_refused_before_the_start():
    stiff = path_of(models=(DoubleIntegrator(damping=1e9),) * 4, dt=0.01)
    report = design_report(stiff)
    assert (report["plant_step_s"], report["plant_agent"]) == (1e-9, "cart_0")
    assert report["feasible"] is False
    assert "dt = 0.01 s is too long: the drift of 'cart_0' takes 1e-09 s at a time" in report["error"]
    with pytest.raises(ValueError, match=r"dt = 0\.01 s is too long"):
        stiff.build(law=make_law("tanh")).step(0.01)
    assert design_report(paper())["plant_step_s"] is None
    assert design_report(mixed_fleet())["plant_step_s"] == pytest.approx(0.0555, abs=1e-4)
    assert design_report(mixed_fleet())["plant_agent"] == "vessel_0"


def test_a_task_graph_that_falls_apart_is_worth_a_warning():
    apart = nx.Graph([(0, 1), (2, 3)])
    (warning,) = design_report(path_of(task=apart))["warnings"]
    assert warning == (
        "the task graph falls into 2 parts, which agree among themselves only: integrator_0, integrator_1; "
        "integrator_2, integrator_3"
    )
    assert design_report(path_of())["warnings"] == []


class Drizzle(Term):
    """A user's own disturbance."""

    def add(self, t, x, drawn, channels, out):
        out[:, channels.index] += channels.amplitude


class TestAssumptions:
    def test_a_users_own_disturbance_is_not_known(self):
        found = assumption(design_report(path_of(disturbance=Drizzle(0.2) + Sinusoid(0.1))), "1-iii")
        assert found["status"] == "not known"
        assert "|w| <= 0.3" in found["why"]
        assert "Drizzle: your own" in found["why"]
        assert "smooth" not in found["why"]
        assert assumption(design_report(path_of(disturbance=Sinusoid(0.1))), "1-iii")["status"] == "holds"

    def test_a_users_own_bound_need_not_decrease(self):
        found = assumption(design_report(path_of(delta=Own(0.1, 0.1))), "6")
        assert found["status"] == "not known"
        assert "Own" in found["why"]

    def test_disturbance_bound_is_told(self):
        assert "|w| <= 0.3" in assumption(design_report(paper()), "1-iii")["why"]
        assert assumption(design_report(path_of()), "1-iii")["why"] == "w = 0"

    def test_relay(self):
        assert assumption(design_report(path_of()), "4")["status"] == "holds by construction"
        report = design_report(path_of(relay=False))
        assert assumption(report, "4")["status"] == "doesn't hold"
        assert report["feasible"] is True

    def test_a_persistent_disturbance_is_no_error(self):
        report = design_report(paper())
        assert assumption(report, "5")["status"] == "doesn't hold"
        assert report["feasible"] is True
        assert assumption(design_report(path_of()), "5")["status"] == "holds"
        assert assumption(design_report(paper().replace(disturbance=None)), "5")["status"] == "not known"

    def test_integrators_descend_what_is_said_to_decrease_at_their_limits_too(self):
        """In a star with slow leaves the centre, above the mean, keeps rising: |Pi x|^2 grows while V decreases."""
        star = nx.star_graph(4)
        scenario = path_of(
            5,
            communication=star,
            task=star,
            models=(SingleIntegrator(dim=1, input_limit=9.0),) + (SingleIntegrator(dim=1, input_limit=0.1),) * 4,
            law=LawChoice("tanh", {"gain": 2.0}),
            radius=10.0,
        ).sized()
        found = assumption(design_report(scenario), "5")
        assert found["status"] == "holds"
        assert "log cosh" in found["why"]
        assert "inputs at their limits included" in found["why"]
        simulator = scenario.build(law=make_law(scenario.law), observe="oracle")
        simulator.reset(x0=[5.0, 6.0, 6.0, 6.0, -10.0])
        edges = np.array(star.edges)
        spreads, sums = [], []
        for _ in range(400):
            x = simulator.x
            spreads.append(((x - x.mean(axis=1, keepdims=True)) ** 2).sum(axis=1))
            sums.append(np.log(np.cosh(x[:, edges[:, 0]] - x[:, edges[:, 1]])).sum(axis=1))
            simulator.step(0.01)
        assert (np.diff(spreads, axis=0) > 1e-6).any()  # what was said to decrease once
        assert (np.diff(sums, axis=0) <= 1e-12).all()

    def test_a_disturbance_that_vanishes_at_agreement_says_nothing_against_it(self):
        """Nor does a disturbance of states that don't drive positions, so nothing is claimed."""
        for disturbance in (Coupling(0.5), Drizzle(0.2)):
            found = assumption(design_report(path_of(disturbance=disturbance)), "5")
            assert found["status"] == "not known"
            assert "vanishes in agreement, or is your own" in found["why"]
        heading = Sinusoid((0.0, 0.0, 0.3))
        bound = Exponential(10.0, 0.1, 5.0)
        found = assumption(
            design_report(path_of(models=(Unicycle(),) * 4, disturbance=heading, delta=bound, theta=None)), "5"
        )
        assert found["status"] == "not known"
        assert assumption(design_report(path_of(disturbance=Sum())), "5")["status"] == "holds"
        assert assumption(design_report(path_of(disturbance=Sum())), "1-iii")["why"] == "w = 0"

    def test_the_gain_that_would_do_near_agreement_is_told(self):
        """lambda_2 of the paper's task graph, with the law's gain and without a gain in the file."""
        calm = paper().replace(disturbance=None)
        enough = 1.0 / nx.algebraic_connectivity(calm.task)
        assert f"= {enough:.4g} 1/s (here k_c = 2)" in assumption(design_report(calm), "5")["why"]
        without = assumption(design_report(calm.replace(law=LawChoice("tanh"))), "5")["why"]
        assert f"= {enough:.4g} 1/s; far" in without

    def test_unbounded_g_is_bounded_in_time_only_if_the_law_makes_it_so(self):
        free = (SingleIntegrator(input_limit=np.inf),) * 2 + (SingleIntegrator(input_limit=4.0),) * 2
        found = assumption(design_report(path_of(models=free)), "2")
        assert found["status"] == "not known"
        assert found["why"].startswith(
            "(i) g is bounded for 2 of 4 agents, |g| <= 4 in every component; (ii) for the 4"
        )
        assert assumption(design_report(path_of()), "2")["status"] == "holds"

    def test_gusts_are_continuous_and_not_said_to_be_smooth(self):
        why = assumption(design_report(path_of(disturbance=Gust(0.2))), "1-iii")["why"]
        assert why == "|w| <= 0.2 in every component, as declared by Gust, all continuous"

    def test_an_agent_alone_is_at_its_goal(self):
        alone = path_of(1, delta=Exponential(1.0, 1.0, 1.0))
        assert assumption(design_report(alone), "5")["status"] == "holds"

    def test_locally_lipschitz_drift_is_told(self):
        why = assumption(design_report(mixed_fleet()), "1-i")["why"]
        assert "vessel: only locally Lipschitz" in why

    def test_without_f_the_motion_has_to_be_bounded(self):
        report = design_report(path_of(observers=(TargetObservers(drift=False),) * 4))
        assert "Theorem 2" in assumption(report, "1-i")["why"]

    def test_a_users_own_model_is_not_known(self):
        class Rover(SingleIntegrator):
            type = "rover"

            def drift_lipschitz(self) -> float:
                return AgentModel.drift_lipschitz(self)

        report = design_report(path_of(models=(Rover(input_limit=4.0),) * 4))
        assert assumption(report, "1-i")["status"] == "not known"
        assert assumption(report, "1-ii")["status"] == "not known"

    def test_steady_state_norm_is_over_all_pairs_and_components(self):
        """Four agents in a row: each of the 4 pairs at distance 2 has two components of delta(inf) = 0.1."""
        why = assumption(design_report(path_of()), "6")["why"]
        assert f"{0.1 * math.sqrt(4 * 2):.4g}" in why
        decay = math.log((10.0 - 0.1) / (0.05 * 0.1)) / 5.0  # all deltas are equal: 5 % above delta(inf)
        assert f"t_x = {decay:.3g} s" in why
