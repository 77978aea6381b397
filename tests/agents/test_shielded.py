"""Environments and trainings inside the safety filter: the same actions as its policies', and nobody collides."""

import copy
import dataclasses
import warnings

import numpy as np
import pytest

from agents import SafetyFilter, ShieldedEnv, describe, evaluate, make_policy, shielded
from agents.learning import LearnedPolicy, TrainingConfig
from agents.learning.environment import training_environment
from agents.learning.shielded import ShieldedSB3VecEnv
from agents.learning.training import train
from agents.navigation import KeepRight
from agents.policy import by_agent
from khop_env import make_sb3_vec, navigation_v0
from khop_env.env import CostsApart
from khop_env.env.sb3 import KHopSB3VecEnv
from khop_env.registry import make_batched

with warnings.catch_warnings():  # the import makes example environments in a way that PettingZoo itself deprecates
    warnings.filterwarnings("ignore", "The old environment creation API", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test

TINY = TrainingConfig(
    "navigation_v0",
    shield="certified",
    nearest=True,
    num_envs=4,
    hidden=(8,),
    timesteps=4000,
    evaluations=2,
    arguments={"max_cycles": 20, "penalty": 0.5},
)


def parallel(options=None, **arguments):
    env = navigation_v0.parallel_env(**{"bounds": True, "max_cycles": 30, **arguments})
    return ShieldedEnv(env, **(options or {}))


def played(policy, cycles, seed, message_size=0):
    """By control period: observations (N, D) with bounds, and interventions (N,) of a filtered policy."""
    env = make_batched("navigation_v0", bounds=True, num_envs=1, max_cycles=30, message_size=message_size)
    policy.reset(describe(env), [0])
    observations, _ = env.reset(seed)
    found = []
    for _ in range(cycles):
        actions = policy.act(by_agent(env, observations))
        observations, *_ = env.step(np.stack(list(actions.values()), axis=1))
        found.append((observations[0], np.array([policy.intervention[agent][0] for agent in env.agents])))
    return found


@pytest.mark.parametrize("options", [{}, {"margin": "none"}, {"margin": 0.1, "gamma": 0.5}, {"announce": True}])
def test_a_shielded_environment_does_what_the_filter_does_round_a_policy(options):
    """Bit for bit, over an episode in which it has to intervene."""
    size = 4 if "announce" in options else 0
    expected = played(shielded("go_to_goal", **options), 30, 3, size)
    env, learner = parallel(options, message_size=size), make_policy("go_to_goal")
    observations, infos = env.reset(3)
    assert {info["intervention"] for info in infos.values()} == {0.0}
    learner.reset(env.filter.inside, [0])
    for rows, intervention in expected:
        observations, _, _, _, infos = env.step(learner.act(observations))
        for number, agent in enumerate(env.possible_agents):
            kept = env.filter.seen({each: rows[q] for q, each in enumerate(env.possible_agents)})
            np.testing.assert_array_equal(observations[agent], kept[agent])
            assert infos[agent]["intervention"] == intervention[number]
            assert infos[agent]["infeasible"] is False
    assert max(intervention.max() for _, intervention in expected) > 0.1
    assert len(observations[env.possible_agents[0]]) == len(env.layout(env.possible_agents[0]))
    assert not any("bound" in name for name in env.layout(env.possible_agents[0]).names)


@pytest.mark.parametrize("announce", [False, True])
def test_rows_for_stable_baselines3_do_the_same(announce):
    """Each environment of the batch, also after the ends of episodes, where the filter begins anew."""
    options = {"num_envs": 3, "bounds": True, "max_cycles": 12, "message_size": 4 * announce}
    rows = ShieldedSB3VecEnv(make_sb3_vec("navigation_v0", **options), SafetyFilter(None, announce=announce))
    env = make_batched("navigation_v0", **options)
    policy, learner = shielded("go_to_goal", announce=announce), make_policy("go_to_goal")
    rows.seed(5)
    seen, agents = rows.reset(), env.agents
    assert seen.shape == (24, *rows.observation_space.shape)
    for episode in range(2):
        policy.reset(describe(env), [0, 1, 2])
        learner.reset(rows.filter.inside, [0, 1, 2])
        observations, _ = env.reset([5, 6, 7] if episode == 0 else None)
        for cycle in range(12):
            by_row = {agent: seen.reshape(3, 8, -1)[:, number] for number, agent in enumerate(agents)}
            wanted = np.stack(list(learner.act(by_row).values()), axis=1).reshape(24, 2)
            actions = policy.act(by_agent(env, observations))
            observations, *_ = env.step(np.stack(list(actions.values()), axis=1))
            seen, _, dones, infos = rows.step(wanted)
            last = np.stack([info["terminal_observation"] for info in infos]) if cycle == 11 else seen
            kept = policy.seen(by_agent(env, observations))
            np.testing.assert_array_equal(last, np.stack([kept[agent] for agent in agents], axis=1).reshape(24, -1))
            for agent in agents:
                np.testing.assert_array_equal(rows.filter.intervention[agent], policy.intervention[agent])
                assert not rows.filter.infeasible[agent].any()
        assert dones.all()
        assert [info["intervention"] for info in infos[:8]] == [
            float(policy.intervention[agent][0]) for agent in agents
        ]
        assert not any(info["infeasible"] for info in infos)
    with pytest.raises(ValueError, match=r"actions must have shape \(24, 2\); got \(24, 3\)"):
        rows.step(np.zeros((24, 3)))


@pytest.mark.filterwarnings("ignore:.*reset.. ignores the option")
@pytest.mark.parametrize("uniform", [True, False])
def test_pettingzoo(uniform):
    """Its tests of the parallel form, and of seeds."""
    parallel_api_test(parallel(uniform=uniform, max_cycles=5), 8)
    parallel_seed_test(lambda: parallel(uniform=uniform, max_cycles=5), 8)


def test_states_are_saved_with_what_the_filter_remembers():
    """A copy, and an environment with the state restored, go on bit for bit."""
    env = parallel()
    env.reset(1)
    rng = np.random.default_rng(0)
    actions = [{agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents} for _ in range(12)]
    for each in actions[:6]:
        env.step(each)
    restored = parallel()
    restored.reset(2)
    restored.set_state(env.get_state())
    copied = copy.deepcopy(env)
    for each in actions[6:]:
        results = [of.step(each) for of in (env, restored, copied)]
        for agent in env.agents:
            for other in results[1:]:
                np.testing.assert_array_equal(results[0][0][agent], other[0][agent])
                assert results[0][4][agent] == other[4][agent]
                assert other[4][agent]["infeasible"] is False


def test_refused_actions_change_nothing():
    """Neither the environment nor what the filter remembers; and evaluate() doesn't pass the filter by."""
    env = parallel()
    env.reset(1)
    fine = dict.fromkeys(env.agents, np.ones(2, np.float32))
    for _ in range(20):  # until messages have arrived, and agents move
        env.step(fine)
    before = env.filter.get_state()
    for actions, error, message in (
        ({**fine, "integrator_3": np.array([np.nan, 0.0])}, ValueError, "'integrator_3' isn't finite"),
        ({**fine, "cart_0": np.zeros(2)}, ValueError, "no agent 'cart_0'"),
        ({**fine, "integrator_3": "left"}, ValueError, "the action of 'integrator_3' isn't numbers: 'left'"),
        ({"integrator_0": np.zeros(2)}, ValueError, "got no action for 'integrator_1'"),
        ({**fine, "integrator_0": np.zeros(3)}, ValueError, r"must have shape \(1, 2\).* got \(3,\)"),
        (np.zeros((8, 2)), TypeError, "takes a mapping"),
    ):
        with pytest.raises(error, match=message):
            env.step(actions)
        for name, values in env.filter.get_state().items():
            np.testing.assert_array_equal(values, before[name])
    env.step(fine)
    assert not any(each.any() for each in env.filter.infeasible.values())
    with pytest.raises(TypeError, match=r"give them env\.unwrapped and the policy shielded"):
        evaluate(env, ["zero"], [0])
    with pytest.raises(TypeError, match=r"get_state\(\) of a ShieldedEnv returned; got EnvState"):
        env.set_state(env.unwrapped.get_state())
    with pytest.raises(ValueError, match="there is no policy inside the safety filter"):
        env.filter.act({agent: env.unwrapped.observe(agent) for agent in env.agents})
    with pytest.raises(ValueError, match=r"reads the \d+ columns of 'integrator_0'.* it got 55"):
        env.filter.correct({agent: env.observe(agent) for agent in env.agents}, fine)
    with pytest.raises(ValueError, match="make the environment with bounds=True"):
        parallel(bounds=False)


def test_frames_show_what_the_filter_changes():
    """As those of `khop run` do; not any more after a reset, and as before where actions are refused."""
    env, learner = parallel(max_cycles=100, render_mode="rgb_array"), make_policy("go_to_goal")
    observations, _ = env.reset(3)
    learner.reset(env.filter.inside, [0])
    world, first = env.unwrapped.batched.world, env.render()
    for _ in range(30):
        observations, *_ = env.step(learner.act(observations))
    correction = np.stack([env.filter.correction[agent] for agent in env.possible_agents])
    lengths = np.linalg.norm(world.arrows[..., 0], axis=1)
    np.testing.assert_allclose(lengths, np.minimum(0.5 * np.linalg.norm(correction, axis=1), 0.75))
    assert lengths.max() > 0.1
    assert world.marked.shape == (8, 1)
    frame, shown = env.render(), world.arrows
    with pytest.raises(ValueError, match="isn't finite"):
        env.step({agent: np.full(2, np.nan) for agent in env.agents})
    assert world.arrows is shown
    world.arrows = world.marked = None
    assert not np.array_equal(frame, env.render())
    env.step(learner.act(observations))
    assert world.arrows is not None
    env.reset(3)
    assert world.arrows is world.marked is None
    np.testing.assert_array_equal(env.render(), first)


def test_what_a_shielded_environment_cannot_step_is_refused():
    """When it is made, with what to do; costs come apart around it."""
    env = navigation_v0.parallel_env(bounds=True, max_cycles=30)
    for wrong, message in (
        (CostsApart(env), r"CostsApart\(ShieldedEnv\(env\)\), not ShieldedEnv\(CostsApart\(env\)\)"),
        (ShieldedEnv(env), "is a ShieldedEnv already"),
        (CostsApart(ShieldedEnv(env)), "costs come apart last"),
        (make_batched("navigation_v0", bounds=True), r"got BatchedEnv. Batches: SafetyFilter\(None, ...\).correct"),
        (navigation_v0.env(bounds=True), "around a ParallelEnv of khop_env"),
        (None, "got NoneType"),
    ):
        with pytest.raises(TypeError, match=message):
            ShieldedEnv(wrong)
    apart = CostsApart(ShieldedEnv(env))
    apart.reset(3)
    assert len(apart.step(dict.fromkeys(apart.agents, np.zeros(2, np.float32)))) == 6
    with pytest.raises(ValueError, match="in a safety filter already"):
        shielded(shielded("zero"))


def test_a_policy_is_reset_with_what_the_filter_leaves():
    """Whatever is around the ShieldedEnv; the same loop plays it as any other environment."""
    inner = navigation_v0.parallel_env(bounds=True, max_cycles=3)
    env, policy = ShieldedEnv(inner), make_policy("go_to_goal")
    for each in (env, CostsApart(env)):
        assert describe(each) is env.filter.inside
        assert describe(each).shielded
        assert not any(".bound." in name for name in describe(each).layouts[inner.possible_agents[0]].names)
    assert not describe(inner).shielded
    rows = ShieldedSB3VecEnv(make_sb3_vec("navigation_v0", num_envs=2, bounds=True), SafetyFilter(None))
    assert describe(rows) is rows.filter.inside
    policy.reset(describe(env), [0])
    observations, _ = env.reset(seed=0)
    while env.agents:
        observations, *_ = env.step(policy.act(observations))


def test_a_filter_takes_policies_only():
    with pytest.raises(TypeError, match="the policy is the class KeepRight: pass an instance"):
        shielded(KeepRight)
    with pytest.raises(TypeError, match=r"the policy is of type function: a policy has reset\(env, seeds\)"):
        shielded(make_policy)


@pytest.mark.parametrize("shield", ["certified", None])
def test_a_training_inside_the_shield_never_collides(monkeypatch, shield):
    """And outside it does, so that the test can fail; the learner gets no bounds in either."""
    costs, step = [], KHopSB3VecEnv.step_wait

    def recorded(env):
        result = step(env)
        costs.append(env.infos["cost"].max())
        return result

    monkeypatch.setattr(KHopSB3VecEnv, "step_wait", recorded)
    config = dataclasses.replace(TINY, shield=shield, evaluations=1, arguments={"max_cycles": 100}, log_std=1.0)
    training = train(dataclasses.replace(config, timesteps=6000))
    assert len(costs) > 100
    assert (max(costs) > 0.0) == (shield is None)
    assert not any("bound" in name for name in training.policy.columns)
    assert training.policy.about["shield"] == shield


class _StopError(Exception):
    pass


def test_a_resumed_training_keeps_the_shield(tmp_path):
    """It goes on bit for bit, in the middle of episodes, and is refused with another shield."""
    whole = train(TINY).curve
    done = []

    def stop(fraction, evaluation):
        done.append(evaluation)
        if evaluation is None and len(done) > 1 and any(done):
            raise _StopError

    with pytest.raises(_StopError):
        train(TINY, tmp_path, on_progress=stop)
    with pytest.raises(ValueError, match="shield = 'certified' there and None here; resume with the same settings"):
        train(dataclasses.replace(TINY, shield=None), tmp_path, resume=True)
    resumed = train(TINY, tmp_path, resume=True)
    assert len(resumed.curve) > 1
    assert resumed.curve == whole
    policy = LearnedPolicy.load(tmp_path)
    env = describe(make_batched("navigation_v0"))
    with pytest.warns(
        UserWarning, match="trained inside the safety filter is played outside of it.*--shield certified"
    ):
        policy.reset(env, [0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shielded(policy).reset(describe(make_batched("navigation_v0", bounds=True)), [0])


def test_shields_are_checked():
    """In words that name the setting, before there is a folder."""
    with pytest.raises(ValueError, match=r"margin must be 'certified', 'none' or a number of metres.*'safe'"):
        dataclasses.replace(TINY, shield="safe")
    with pytest.raises(ValueError, match="dead_reckoning=True is for a filter with a policy"):
        dataclasses.replace(TINY, shield="none,dead_reckoning=true")
    assert dataclasses.replace(TINY, shield=0.3).shield == "0.3"
    with pytest.raises(ValueError, match="the disturbance pushes 'unicycle_0' aside"):
        training_environment(
            dataclasses.replace(TINY, environment="consensus_v0", scenario="mixed_fleet", arguments={})
        )


def test_interventions_are_taken_from_the_training_reward():
    """By metre, of the agent whose action was changed; not from the environment's own reward."""
    config = dataclasses.replace(TINY, arguments={"max_cycles": 100})
    both = [training_environment(dataclasses.replace(config, intervention=each)) for each in (0.0, 2.0)]
    for env in both:
        env.training = env.norm_reward = False
        env.seed(0)
        env.reset()
    rng, shield = np.random.default_rng(0), both[0].venv.shield
    taken = []
    for _ in range(60):
        actions = rng.uniform(-1, 1, (32, 2)).astype(np.float32)
        plain, less = (env.step(actions)[1] for env in both)
        changed = np.stack([shield.filter.intervention[agent] for agent in shield.batched.agents], axis=1)
        np.testing.assert_allclose(plain - less, 2.0 * 0.05 * changed.reshape(-1), atol=1e-6)
        taken.append(changed.max())
    assert max(taken) > 0.1


def test_actions_beyond_the_limits_cost_what_they_exceed_them_by():
    """They act as if clipped, and everything else stays as it is."""
    config = dataclasses.replace(TINY, shield=None, arguments={"max_cycles": 100})
    both = [training_environment(dataclasses.replace(config, saturation=each)) for each in (0.0, 2.0)]
    for env in both:
        env.training = env.norm_reward = False
        env.seed(0)
        env.reset()
    rng = np.random.default_rng(0)
    for _ in range(5):
        actions = rng.uniform(-3, 3, (32, 2)).astype(np.float32)
        (first, plain, *_), (second, less, *_) = (env.step(actions) for env in both)
        np.testing.assert_array_equal(first, second)
        excess = np.square(np.maximum(np.abs(actions) - 1.0, 0.0)).sum(axis=1)
        np.testing.assert_allclose(plain - less, 2.0 * 0.05 * excess, atol=1e-6)
    trained = train(dataclasses.replace(config, saturation=0.5, timesteps=500, evaluations=1))
    assert trained.policy.action_size == 2
