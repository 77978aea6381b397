"""Registered names, and SuperSuit's conversion with Stable-Baselines3 on top. Other libraries, which ask for other
versions or much time to install, are scripts in `examples/integrations`.
"""

import subprocess
import sys

import gymnasium
import numpy as np
import pettingzoo
import pytest
import supersuit
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from khop_env import make_sb3_vec, make_vec
from khop_env.env.rendering import canvas
from tests.env.playing import ENVIRONMENTS, EVERY, IDS, aec, built, parallel, play, same

by_name = pytest.mark.skipif(not hasattr(pettingzoo, "register"), reason="PettingZoo makes by name from 1.26 on")


def supersuited(environment="consensus_v0", name="paper", **arguments):
    return supersuit.pettingzoo_env_to_vec_env_v1(parallel(environment, name, **arguments))


class TestNames:
    def test_all_are_registered(self):
        """Gymnasium and PettingZoo know the same names, and no others of ours."""
        registries = [gymnasium.registry]
        if hasattr(pettingzoo, "register"):
            registries += [pettingzoo.aec_registry, pettingzoo.parallel_registry]
        for registry in registries:
            assert {name for name in registry if name.startswith("khop/")} == set(IDS.values())

    @by_name
    @pytest.mark.parametrize("environment", ENVIRONMENTS)
    def test_parallel(self, environment):
        """PettingZoo's make gives the module's environment, arguments included."""
        made = pettingzoo.make("parallel", IDS[environment], scenario="convoy", uniform=False, max_cycles=4)
        expected = parallel(environment, "convoy", uniform=False, max_cycles=4)
        assert made.unwrapped.metadata == expected.metadata
        assert same(made.reset(seed=1), expected.reset(seed=1))
        assert same(play(made, 9), play(expected, 9))

    @by_name
    @pytest.mark.parametrize("environment", ENVIRONMENTS)
    def test_aec(self, environment):
        made = pettingzoo.make("aec", IDS[environment], scenario="convoy", max_cycles=4)
        expected = aec(environment, "convoy", max_cycles=4)
        for env in (made, expected):
            env.reset(seed=1)
        turns = 0
        for agent in made.agent_iter():
            turns += 1
            seen = made.last()
            assert agent == expected.agent_selection
            assert same(seen, expected.last())
            for env in (made, expected):
                env.step(None if seen[2] or seen[3] else np.full(2, 0.5, np.float32))
        assert turns == 5 * len(made.possible_agents)  # four cycles, and a last look
        assert not expected.agents

    @pytest.mark.parametrize(
        "before",
        [
            pytest.param("del pettingzoo.register, pettingzoo.aec_registry", id="older", marks=by_name),
            pytest.param("import khop_env; del sys.modules['khop_env']", id="again"),
        ],
    )
    def test_import(self, before):
        """Without PettingZoo's registry, and a second time: no error, no warning, and environments that step."""
        script = f"""
import sys, pettingzoo
{before}
import gymnasium
from khop_env import consensus_v0
env = consensus_v0.parallel_env()
env.reset(seed=0)
env.step(dict.fromkeys(env.agents, [0.0, 0.0]))
gymnasium.make("khop/Consensus-v0").reset(seed=0)
"""
        command = [sys.executable, "-W", "error::UserWarning", "-c", script]
        found = subprocess.run(command, capture_output=True, text=True)
        assert found.returncode == 0, found.stderr


class TestConstruction:
    """Arguments that other libraries try, and what they make of our refusals."""

    @pytest.mark.parametrize(
        "make",
        [
            lambda **wrong: gymnasium.make("khop/Consensus-v0", **wrong),
            lambda **wrong: make_vec("consensus_v0", **wrong),
            lambda **wrong: make_sb3_vec("consensus_v0", **wrong),
            lambda **wrong: parallel("leader_following_v0", **wrong),
            lambda **wrong: aec("formation_v0", **wrong),
        ],
        ids=["gymnasium", "vector", "sb3", "parallel", "aec"],
    )
    def test_unknown_arguments_are_refused_in_python_s_words(self, make):
        """TorchRL's GymEnv tries frameskip, and leaves it out if it reads these words."""
        with pytest.raises(TypeError, match="got an unexpected keyword argument 'frameskip'; known: scenario, "):
            make(frameskip=1)

    @pytest.mark.parametrize("make", [make_vec, make_sb3_vec])
    def test_render_modes_of_batches_too(self, make):
        with pytest.raises(TypeError, match="unexpected keyword argument 'render_mode': batches aren't rendered"):
            make("consensus_v0", render_mode="rgb_array")

    def test_lists_of_frames(self):
        """gymnasium.make collects them itself where the environment has render modes."""
        env = gymnasium.make("khop/Consensus-v0", scenario=built("paper"), render_mode="rgb_array_list")
        single = gymnasium.make("khop/Consensus-v0", scenario=built("paper"), render_mode="rgb_array")
        frames = []
        env.reset(seed=0)
        single.reset(seed=0)
        for _ in range(3):
            frames.append(single.render())
            for one in (env, single):
                one.step(np.zeros(16, np.float32))
        frames.append(single.render())
        collected = env.render()
        assert len(collected) == 4
        assert all(np.array_equal(*pair) for pair in zip(collected, frames, strict=True))

    def test_stable_baselines3_s_make_vec_env_without_pygame(self, monkeypatch):
        """It asks for rgb_array by itself."""
        canvas.load_pygame.cache_clear()
        monkeypatch.setitem(sys.modules, "pygame", None)
        env = make_vec_env("khop/Consensus-v0", n_envs=2, seed=0, env_kwargs={"scenario": built("paper")})
        assert env.render_mode == "rgb_array"
        assert env.reset().shape == (2, *env.observation_space.shape)
        env.step(np.zeros((2, 16), np.float32))


class TestSuperSuit:
    @pytest.mark.parametrize(("environment", "name"), EVERY)
    def test_rows_are_agents(self, environment, name):
        """Also over the end of an episode, after which SuperSuit resets."""
        env, expected = supersuited(environment, name, max_cycles=3), parallel(environment, name, max_cycles=3)
        agents = expected.possible_agents
        observations, _ = expected.reset(seed=2)
        assert env.num_envs == len(agents)
        assert env.reset(seed=2)[0].tobytes() == np.stack(list(observations.values())).tobytes()
        rng = np.random.default_rng(0)
        for _ in range(5):
            actions = rng.uniform(-1.0, 1.0, (len(agents), *env.action_space.shape)).astype(np.float32)
            observations, rewards, terminated, truncated, _ = expected.step(dict(zip(agents, actions, strict=True)))
            if not expected.agents:
                observations, _ = expected.reset()
            seen, seen_rewards, seen_terminated, seen_truncated, _ = env.step(actions)
            assert seen.tobytes() == np.stack(list(observations.values())).tobytes()
            assert same(seen_rewards, np.array(list(rewards.values()), np.float32))
            assert seen_terminated.tolist() == list(terminated.values())
            assert seen_truncated.tolist() == list(truncated.values())

    def test_ppo(self):
        """Two copies in one process. No seed is given, because SuperSuit's wrapper refuses it."""
        env = supersuit.concat_vec_envs_v1(supersuited(max_cycles=5), 2, base_class="stable_baselines3")
        torch.manual_seed(0)
        model = PPO("MlpPolicy", env, n_steps=8, batch_size=64, n_epochs=1, device="cpu")
        before = [one.detach().clone() for one in model.policy.parameters()]
        model.learn(2 * 8 * env.num_envs)
        assert model.num_timesteps == 256
        assert all(torch.isfinite(one).all() for one in model.policy.parameters())
        assert any(not torch.equal(*pair) for pair in zip(before, model.policy.parameters(), strict=True))
