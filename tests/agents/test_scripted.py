"""Scripted policies: the simulator's law on observations alone, with progress in every environment."""

import numpy as np
import pytest

from agents import LAWS, POLICIES, LawPolicy, describe, make_law, make_policy, play
from agents.policy import by_agent
from khop_env.scenarios import LawChoice
from khop_env.simulation import View
from tests.env.playing import ALONG_EDGES, CROSS_ALONG_EDGES, EVERY_ALONG_EDGES, MODES, batched, parallel

PARAMETERS = {  # all of them, so that no shipped ones are used
    "tanh": {"gain": 1.3},
    "linear": {"gain": 0.7, "cancel_drift": True},
    "formation": {"gain": 1.7, "speed": 0.4, "cancel_drift": False},
    "leader_following": {"gain": 2.5, "shrink": 0.8, "cancel_drift": True},
}


def true_view(env):
    """The view that the law would get if the acting agents were a fleet of their own, from the simulator's arrays."""
    fleet, task, simulator = env.fleet, env.task, env.simulator
    design, x = simulator.design, simulator.x
    number = {fleet.agent(agent): place for place, agent in enumerate(env.agents)}
    edges, known, displacement = [], [], []
    for layout in env.layouts:
        i = fleet.agent(layout.agent)
        for slot in (each for each in layout.slots if each.task_edge):
            j = slot.agent
            edge = np.flatnonzero((task.edges == (i, j)).all(axis=1))[0]
            columns = fleet.position_index[j]
            if slot.heard or env.settings.observe == "oracle":
                other = x[:, columns]
            else:
                other = simulator.estimates[:, design.states.layout.slot[i, j] + columns - fleet.state_offset[j]]
            sees = slot.heard or env.settings.observe != "local"
            edges.append((number[i], number.get(j, -1)))
            known.append(sees)
            displacement.append(sees * (other - x[:, fleet.position_index[i]] - task.displacement[edge]))
    acting = type(fleet)([fleet.models[fleet.agent(agent)] for agent in env.agents])
    own = np.concatenate([x[:, fleet.state_slice(fleet.agent(agent))] for agent in env.agents], axis=1)
    columns = np.ascontiguousarray(np.array(displacement).transpose(0, 2, 1))
    return View(acting, own, np.array(edges), np.tile(known, (len(own), 1)), columns.transpose(2, 0, 1)), acting


@pytest.mark.parametrize(("environment", "scenario", "observe", "uniform"), CROSS_ALONG_EDGES)
@pytest.mark.parametrize("law", LAWS)
def test_a_policy_does_what_its_law_does(environment, scenario, observe, uniform, law):
    """Reading observations by name gives the law what the simulator's arrays hold, to float32."""
    env = batched(environment, scenario, num_envs=3, observe=observe, uniform=uniform)
    parameters = PARAMETERS[law]
    policy = LawPolicy(law, parameters)
    policy.reset(describe(env), seeds=[0, 1, 2])
    observations, _ = env.reset(0)
    rng = np.random.default_rng(0)
    for _ in range(3):
        width = env.action_offset[-1]
        observations, *_ = env.step(rng.uniform(-0.3, 0.3, (3, width)).astype(np.float32))
    actions = policy.act(by_agent(env, observations))
    view, acting = true_view(env)
    policy_law = make_law(LawChoice(law, parameters))
    expected = policy_law(np.full(3, 0.0), view) / acting.input_limit
    for number, (agent, size) in enumerate(describe(env).action_sizes.items()):
        own = expected[:, acting.input_slice(number)]
        assert actions[agent].shape == (3, size)
        assert actions[agent].dtype == np.float32
        assert np.all(np.abs(actions[agent]) <= 1.0)
        np.testing.assert_allclose(actions[agent][:, : own.shape[1]], own, atol=2e-4)
        assert not actions[agent][:, own.shape[1] :].any()


@pytest.mark.parametrize("name", [*LAWS, "zero", "random", "bang_bang"])
def test_one_observation_or_a_batch(name):
    """A policy plays a ParallelEnv as it plays a batch: the same bits for the same seed."""
    single, several = (
        parallel("leader_following_v0", "mixed_fleet"),
        batched("leader_following_v0", "mixed_fleet", num_envs=3),
    )
    policy, batch_policy = make_policy(name), make_policy(name)
    policy.reset(describe(single), seeds=[1])
    batch_policy.reset(describe(several), seeds=[0, 1, 2])
    seen, _ = single.reset(seed=1)
    rows, _ = several.reset(0)
    for _ in range(20):
        actions, batched_actions = policy.act(seen), batch_policy.act(by_agent(several, rows))
        for agent in single.agents:
            assert actions[agent].shape == single.action_space(agent).shape
            np.testing.assert_array_equal(actions[agent], batched_actions[agent][1])
        seen, *_ = single.step(actions)
        rows, *_ = several.step(np.stack([batched_actions[agent] for agent in several.agents], axis=1))


@pytest.mark.parametrize("name", [*LAWS, "zero", "random", "bang_bang"])
@pytest.mark.parametrize("observe", ["estimate", "local"])
def test_a_policy_sees_nothing_beyond_its_observation(name, observe):
    """Changes of states that i has no access to don't change its action; in oracle mode they do."""
    for mode, alike in ((observe, True), ("oracle", name in ("zero", "random", "bang_bang"))):
        env = parallel("consensus_v0", "paper", observe=mode)
        policy = make_policy(name)
        policy.reset(describe(env), seeds=[0])
        seen, _ = env.reset(seed=0)
        for _ in range(3):
            seen, *_ = env.step(policy.act(seen))
        agent = "drifter_0"
        heard = {slot.agent for slot in env.layout(agent).slots if slot.heard}
        state = env.get_state()
        policy.reset(describe(env), seeds=[0])
        before = policy.act(env_observations(env))[agent]
        for i in set(range(8)) - heard - {0}:
            state.simulator.x[env.batched.fleet.state_slice(i)] += 0.5
        env.set_state(state)
        policy.reset(describe(env), seeds=[0])
        after = policy.act(env_observations(env))[agent]
        assert np.array_equal(before, after) is alike


def env_observations(env):
    return {agent: env.observe(agent) for agent in env.possible_agents}


class Spy:
    """Tries to rebuild its environment from the description, and to read the true state there."""

    def __init__(self):
        self.twins = []

    def reset(self, env, seeds):
        twin = batched(env.environment, env.scenario, num_envs=len(seeds), observe=env.observe)
        self.twins.append(twin.reset(seeds)[0])
        self.sizes = env.action_sizes

    def act(self, observations):
        batch = next(iter(observations.values())).shape[0]
        return {agent: np.zeros((batch, self.sizes[agent])) for agent in observations}


def test_a_policy_can_not_rebuild_its_episode():
    """The seeds for a policy's own random numbers differ from the environment's."""
    env, spy = batched("consensus_v0", "convoy", num_envs=3), Spy()
    play(env, spy, range(3))
    truth = env.reset(range(3))[0]
    assert spy.twins[0].shape == truth.shape
    assert not np.any(np.all(spy.twins[0] == truth, axis=(1, 2)))


def test_what_a_policy_is_told_holds_no_environment():
    """No attribute of the description, at any depth, is a simulator, an environment or a state."""
    env = parallel("leader_following_v0", "convoy")
    waiting, seen = [describe(env)], set()
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        assert "simulat" not in type(value).__module__
        assert "Env" not in type(value).__name__ or type(value).__name__ == "EnvDescription"
        if hasattr(value, "__dict__"):
            waiting += list(vars(value).values())
        if isinstance(value, dict):
            waiting += list(value.values())
        elif isinstance(value, list | tuple):
            waiting += list(value)


@pytest.mark.parametrize(("environment", "scenario"), EVERY_ALONG_EDGES)
@pytest.mark.parametrize("law", LAWS)
def test_every_law_makes_progress_everywhere(environment, scenario, law):
    """With the shipped parameters: much nearer to the goal than at the start, close to the result in oracle mode."""
    estimate, oracle = (
        play(batched(environment, scenario, num_envs=8, observe=mode), make_policy(law), range(8))
        for mode in ("estimate", "oracle")
    )
    factor = 4.0 if environment == "leader_following_v0" else 20.0
    assert estimate.task_error[0].mean() > factor * estimate.final_task_error.mean()
    # the opening transient costs that much more in m^2 s; from then on estimates are as good as the truth
    transient = {"consensus_v0": 0.02, "formation_v0": 0.2, "leader_following_v0": 0.75}[environment]
    assert estimate.returns.mean() > 1.05 * oracle.returns.mean() - transient
    assert estimate.final_task_error.mean() < 1.02 * oracle.final_task_error.mean() + 0.001
    assert estimate.max_normalized_disagreement.max() < 1.0
    assert estimate.max_error_to_bound.max() < 1.0


@pytest.mark.parametrize("environment", ALONG_EDGES)
def test_doing_nothing_or_anything_loses(environment):
    env = batched(environment, "convoy", num_envs=16)
    returns = {name: play(env, make_policy(name), range(16)).returns for name in (*LAWS, "zero", "random")}
    worst_law = min(returns[law].mean() for law in LAWS)
    assert returns["zero"].mean() < 10.0 * worst_law
    assert returns["random"].mean() < 10.0 * worst_law


def test_random_actions_are_uniform_and_differ_between_environments():
    env = batched("consensus_v0", "mixed_fleet", num_envs=64)
    policy = make_policy("random")
    policy.reset(describe(env), seeds=range(64))
    first, second = (policy.act(by_agent(env, env.reset(0)[0])) for _ in range(2))
    values = np.stack([first[agent] for agent in env.agents])
    assert abs(values.mean()) < 0.05
    assert abs(values.std() - 3.0**-0.5) < 0.02
    assert len({row.tobytes() for row in values[0]}) == 64
    assert not np.array_equal(first[env.agents[0]], second[env.agents[0]])


def test_policies_by_name():
    assert make_policy("linear:gain=2,cancel_drift=true").parameters == {"gain": 2.0, "cancel_drift": True}
    for spec, said in (
        ("tahn", "no policy 'tahn'; did you mean 'tanh'"),
        ("tanh:gian=2", "no parameter 'gian'; did you mean 'gain'"),
        ("tanh:gain=fast", "gain must be of type float; got 'fast'"),
        ("tanh:gain=-1", "gain must be positive and finite; got -1"),
        ("leader_following:shrink=2", "shrink must be from 0 to 1; got 2"),
        ("linear:cancel_drift=maybe", "cancel_drift must be true or false; got 'maybe'"),
        ("tanh:2", "expected parameter=value after the colon; got '2'"),
        ("zero:gain=1", "'zero' takes no parameters"),
    ):
        with pytest.raises(ValueError, match=said):
            make_policy(spec)


@pytest.mark.parametrize("name", [*POLICIES, "filter:tanh", "ppo:pretrained"])
def test_a_reset_comes_first_and_takes_a_description(name):
    policy, env = make_policy(name), batched("consensus_v0", num_envs=1)
    with pytest.raises(ValueError, match=r"knows no environment yet: call reset\(describe\(env\), seeds\) first"):
        policy.act({agent: np.zeros((1, 4), np.float32) for agent in env.agents})
    for wrong in (env, env.fleet):
        with pytest.raises(TypeError, match=f"expected an EnvDescription, describe.env.; got {type(wrong).__name__}"):
            policy.reset(wrong, [0])


def test_shipped_parameters_are_used_and_given_ones_win():
    env = batched("leader_following_v0", "convoy", num_envs=1)
    policy = LawPolicy("leader_following")
    policy.reset(describe(env), seeds=[0])
    tuned = policy.law
    assert tuned != make_law("leader_following")
    policy = LawPolicy("leader_following", {"gain": 3.5})
    policy.reset(describe(env), seeds=[0])
    assert policy.law.gain == 3.5
    assert policy.law.shrink == tuned.shrink
    family = LawPolicy("tanh")
    family.reset(describe(batched("consensus_v0", "random_geometric:agents=10", num_envs=1)), seeds=[0])
    assert family.law != make_law("tanh")  # those of the family's other member


@pytest.mark.parametrize("mode", MODES)
def test_a_leader_out_of_sight_is_awaited_at_the_origin(mode):
    """Followers without information on their leaders stay near the origin instead of drifting off."""
    env = batched("leader_following_v0", "convoy", num_envs=4, observe=mode)
    play(env, make_policy("leader_following:gain=4"), range(4))
    positions = env.fleet.positions(env.simulator.x)
    followers = [env.fleet.agent(agent) for agent in env.agents]
    assert bool(np.abs(positions[:, followers]).max() < 0.5) is (mode == "local")
