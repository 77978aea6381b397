"""The centralised view: the ParallelEnv's numbers side by side, made by gymnasium.make."""

import copy

import gymnasium
import numpy as np
import pytest

from khop_env.registry import make_joint
from tests.env.playing import ENVIRONMENTS, EVERY, IDS, built, info_keys, joint, parallel, same, state


def made(environment="consensus_v0", name="paper", **arguments):
    return make_joint(environment, scenario=built(name), **arguments)


@pytest.mark.parametrize("uniform", [True, False])
@pytest.mark.parametrize(("environment", "name"), EVERY)
def test_it_is_the_parallel_environment_side_by_side(environment, name, uniform):
    """Observations and actions concatenated in the agents' order, the mean reward, over two episodes."""
    arguments = {"observe": "oracle", "uniform": uniform, "max_cycles": 3}
    env, other = made(environment, name, **arguments), parallel(environment, name, **arguments)
    agents = other.possible_agents
    rng = np.random.default_rng(0)
    for seed in (6, None):
        observation, info = env.reset(seed=seed)
        observations, infos = other.reset(seed=seed)
        assert observation.tobytes() == np.concatenate([observations[one] for one in agents]).tobytes()
        over = False
        while not over:
            action = rng.uniform(-4.0, 4.0, env.action_space.shape).astype(np.float32)
            ends = np.cumsum([other.action_space(one).shape[0] for one in agents])
            observation, reward, terminated, truncated, info = env.step(action)
            observations, rewards, _, truncations, infos = other.step(
                dict(zip(agents, np.split(action, ends[:-1]), strict=True))
            )
            assert env.observation_space.contains(observation)
            assert observation.tobytes() == np.concatenate([observations[one] for one in agents]).tobytes()
            assert reward == pytest.approx(np.mean(list(rewards.values())), rel=1e-12)
            assert (terminated, truncated) == (False, truncations[agents[0]])
            assert env.state().tobytes() == other.state().tobytes()
            together = {key: [infos[each][key] for each in agents] for key in info_keys(environment)}
            assert info["task_error"] == pytest.approx(np.mean(together["task_error"]), rel=1e-12)
            assert info["max_error_to_bound"] == max(together["max_error_to_bound"])
            assert info["max_normalized_disagreement"] == max(together["max_normalized_disagreement"])
            assert info["clipped_actions"] == sum(together["clipped_actions"]) > 0
            assert info["clipped_observations"] == sum(together["clipped_observations"])
            over = terminated or truncated


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_gymnasium_makes_it(environment):
    """By its id, with every argument of the environment, checkers and wrappers of Gymnasium's own included."""
    env = gymnasium.make(IDS[environment], scenario="convoy", uniform=False, max_cycles=2, observe="local")
    observation, _ = env.reset(seed=1)
    other = parallel(environment, "convoy", uniform=False, observe="local")
    observations, _ = other.reset(seed=1)
    assert observation.tobytes() == np.concatenate(list(observations.values())).tobytes()
    assert env.unwrapped.metadata["name"] == environment
    for truncated in (False, True):
        assert env.step(env.action_space.sample())[3] is truncated


def test_gymnasium_s_vector_environments_take_it():
    """gymnasium.make_vec copies it; copies seeded apart differ."""
    envs = gymnasium.make_vec("khop/Consensus-v0", num_envs=2, vectorization_mode="sync", max_cycles=3)
    observations, _ = envs.reset(seed=[1, 2])
    assert not np.array_equal(observations[0], observations[1])
    for _ in range(5):
        observations, *_ = envs.step(envs.action_space.sample())
        assert envs.observation_space.contains(observations)
    envs.close()


def test_copies_continue_bit_for_bit():
    env = made("leader_following_v0", "mixed_fleet", max_cycles=4)
    env.reset(seed=2)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (3, *env.action_space.shape))
    env.step(actions[0])
    twin = copy.deepcopy(env)
    assert same([twin.step(one) for one in actions], [env.step(one) for one in actions])
    assert same(twin.reset(), env.reset())


def test_success_terminates():
    env = made(success_radius=1e3, max_cycles=1)
    env.reset(seed=0)
    assert env.step(np.zeros(env.action_space.shape))[2:4] == (True, False)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.zeros(15), r"the action must have shape \(16,\); got \(15,\)"),
        (np.zeros((8, 2)), r"the action must have shape \(16,\); got \(8, 2\)"),
        (np.full(16, np.nan), r"the action of 'drifter_0' isn't finite: entry 0 is nan"),
        (np.array(["a"] * 16), r"actions must be numbers of shape"),
    ],
)
def test_bad_actions_are_refused_and_change_nothing(wrong, message):
    env, clean = made(max_cycles=3), made(max_cycles=3)
    assert same(env.reset(seed=1), clean.reset(seed=1))
    for _ in range(3):
        with pytest.raises(ValueError, match=message):
            env.step(wrong)
        assert same(env.step(np.full(16, 0.5)), clean.step(np.full(16, 0.5)))
    assert same(state(env.env), state(clean.env))


def test_bad_seeds_are_refused_and_change_nothing():
    """In the same words as by the ParallelEnv, not in Gymnasium's."""
    env, clean = made(), made()
    assert same(env.reset(seed=1), clean.reset(seed=1))
    with pytest.raises(ValueError, match="a seed must be a non-negative integer, or None; got -1"):
        env.reset(seed=-1)
    assert env.np_random_seed == 1
    assert same(env.step(np.zeros(16)), clean.step(np.zeros(16)))


def test_steps_outside_an_episode_are_refused():
    """Before the first reset, and after the end."""
    env = made(max_cycles=1)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"no episode is running .* call reset\(\) first"):
            env.step(np.zeros(16))
        env.reset(seed=0)
        env.step(np.zeros(16))


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="no environment 'formation'; did you mean 'formation_v0'"):
        make_joint("formation")
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'bound'; did you mean 'bounds'"):
        joint("khop/Consensus-v0", bound=True)
