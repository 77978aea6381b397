"""Policies in the processes of agents act as they do in the environment, on what messages say alone."""

import json

import numpy as np
import pytest

from agents.deployed import PolicyControl, policy_setups, result_of, steps_of
from agents.running import policy_run
from agents.safety import SafetyFilter
from khop_env.network import Network
from khop_env.registry import scenario
from tests.deploy.running import Team
from tests.test_cli import khop

CYCLES = 50


@pytest.mark.parametrize(
    ("name", "spec", "network"),
    [
        ("swap:agents=4", "filter:go_to_goal", Network(0.05, loss=0.3, burst=5.0)),
        ("swap:agents=4,graph=ring", "filter", Network(0.025, loss=0.3, latency=(0.01, 0.06), jitter=0.01)),
        ("corridor:agents=4,model=cart", "filter", Network(0.05, loss=0.2, latency=0.04)),
    ],
)
def test_lockstep_equals_the_environment(name, spec, network, tmp_path, monkeypatch):
    """Observations, actions, states and what becomes of the task; goals, starts and losses are those of the seed."""
    played, again = (
        policy_run(spec, scenario(name), "estimate", 5.0, 3, arguments={"network": network, "estimator": "relay"})
        for _ in range(2)
    )
    steps = steps_of(played, network.period)
    in_a_cycle = round(0.05 / network.period) * steps
    record, act = {}, SafetyFilter.act

    def recorded(policy, observations):
        actions = act(policy, observations)
        changed = max(float(np.max(each)) for each in policy.intervention.values())
        record.setdefault(id(policy), []).append((dict(observations), actions, changed))
        return actions

    monkeypatch.setattr(SafetyFilter, "act", recorded)
    states, policies = [played.x[0].copy()], policy_setups(played, 3)
    with Team(scenario(name), played, tmp_path, steps=steps, rounds=200, policies=policies) as team:
        for _ in range(CYCLES * in_a_cycle + 1):
            team.advance(in_step=True)
        ids, controls = [agent.node.id for agent in team.agents], [agent._control for agent in team.agents]
    for _ in range(CYCLES):
        played.step(0.05)
        states.append(played.x[0].copy())
    collected = team.collected()
    np.testing.assert_allclose(collected.x[::in_a_cycle], states, rtol=0.0, atol=1e-9)
    known = set()
    for agent, control in zip(ids, controls, strict=True):
        found = record[id(control._policy)][1:]  # the first is to compile
        layout = played.env.layout(agent)
        for (observations, actions, _), (wanted, chosen, _) in zip(found, record[id(played.policy)], strict=False):
            np.testing.assert_allclose(observations[agent], wanted[agent], rtol=0.0, atol=1e-6)
            np.testing.assert_allclose(actions[agent], chosen[agent], rtol=0.0, atol=1e-6)
            values = layout.read(wanted[agent])
            known.add(tuple(float(values[f"slot0.{name}"]) for name in ("valid", "heard", "hops")))
        assert len(found) == CYCLES + 1
    assert any(changed > 0.0 for _, _, changed in record[id(played.policy)])
    assert len(known) > 2  # the network shows in observations
    assert result_of(again, collected.x, collected.u, in_a_cycle)["outcomes"]["min_distance"] == pytest.approx(
        played.outcomes["min_distance"]
    )


def test_a_process_gets_its_own_part_of_the_task_only():
    """Not the goals, nor the places, of others."""
    played = policy_run("filter", scenario("swap:agents=4"), "estimate", 1.0, 0)
    goals, places = (played.env.batched.task.memory[name] for name in ("goal", "place"))
    for agent, setup in enumerate(policy_setups(played, 0)):
        assert setup["memory"]["goal"] == goals[agent].tolist()
        text = json.dumps(setup)
        for other in set(range(4)) - {agent}:
            assert not any(str(value) in text for value in (*goals[other].ravel(), *places[other].ravel()))
        control = PolicyControl(
            scenario("swap:agents=4"),
            agent,
            network=played.observers.network,
            estimator="relay",
            **{name: value for name, value in setup.items() if name != "make"},
        )
        assert not control._batched.simulator.x.any()


def test_an_action_that_is_none_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "late_policy.py").write_text(
        "import numpy as np\nclass Late:\n"
        "    def reset(self, env, seeds): self.agents, self.calls = env.agents, 0\n"
        "    def act(self, observations):\n        self.calls += 1\n"
        "        return {agent: np.full(2, np.nan if self.calls > 2 else 0.5) for agent in self.agents}\n"
    )
    played = policy_run("late_policy.py:Late", scenario("swap:agents=4"), "estimate", 1.0, 0)
    chosen = scenario("swap:agents=4")
    with Team(chosen, played, tmp_path, rounds=9, policies=policy_setups(played, 0)) as team:
        team.advance(in_step=True)
        assert all((agent.robot.u == 0.5).all() for agent in team.agents)
        team.advance(in_step=True)
        with pytest.raises(
            ValueError, match=r"the action of 'integrator_0' must be 2 finite numbers; got \[nan, nan\]"
        ):
            team.advance(in_step=True)


def test_real_processes_in_real_time(tmp_path):
    """Agents change places; if no round was missed, the filter has kept them apart."""
    options = ("--controller", "filter", "--duration", "4", "--json", "--out", str(tmp_path / "out"))
    found = json.loads(khop("deploy", "swap:agents=4", *options).stdout)
    assert found["violations"] == 0
    assert found["environment"] == "navigation_v0"
    assert found["final_task_error"] < 4.0
    assert found["deploy"]["missed"] or found["outcomes"]["collision"] == 0.0
    assert 0.3 < found["outcomes"]["min_distance"] < 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("swap:agents=4", "--controller", "filter:announce=true"), "leave announce out"),
        (("swap:agents=4", "--controller", "filter", "--dt", "0.05"), "--dt: a policy acts in its environment"),
        (("swap:agents=4", "--controller", "filter", "--network", "wifi:period=0.07"), "isn't a multiple"),
        (("swap:agents=4", "--controller", "filtre"), "did you mean 'filter'"),
    ],
)
def test_mistakes_are_said(options, message):
    assert message in " ".join(khop("deploy", *options, status=2).stderr.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"environment": "leader_following_v0"}, "leader_following_v0 moves drifter_0"),
        ({"arguments": {"network": "ideal", "actuator": "lag"}}, r"acts through Lag\(time_constant=0.1\)"),
    ],
)
def test_environments_that_processes_cannot_play(arguments, message):
    """Leaders that the task moves, and actuators with a memory of their own."""
    chosen = {"arguments": {"network": "ideal"}, **arguments}
    with pytest.raises(ValueError, match=message):
        steps_of(policy_run("zero", scenario("paper"), "estimate", 1.0, 0, **chosen), 0.05)
