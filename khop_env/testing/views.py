"""Check that all forms of an environment agree: single, batched, vector, SB3 and the team as one agent."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np

from khop_env.env import BatchedEnv, JointEnv, KHopEnv, KHopVectorEnv
from khop_env.simulation import Simulator
from khop_env.testing.equality import difference
from khop_env.testing.subject import Fault, Subject

_COPIES = 3


def views(subject: Subject) -> str:
    """Batched, vector, SB3 and joint forms equal single environments."""
    single = [subject.own() for _ in range(_COPIES)]
    seeds = list(range(subject.seed, subject.seed + _COPIES))
    expected = [[_flat(env, *env.reset(seed=seed))] for env, seed in zip(single, seeds, strict=True)]
    width = int(single[0].batched.action_offset[-1])
    actions = np.random.default_rng(subject.seed).uniform(-1.0, 1.0, (subject.steps, _COPIES, width))
    actions = actions.astype(np.float32)
    for number in range(subject.steps):
        for b, env in enumerate(single):
            step = _flat(env, *env.step(_by_agent(env, actions[number, b])))
            if not env.agents:
                step["next"] = _flat(env, *env.reset())
            expected[b].append(step)
    _batched(copies(single[0], _COPIES), expected, actions, seeds)
    _joint(subject.own(), expected[0], actions[:, 0], seeds[0])
    if not single[0].batched.settings.uniform:
        return "ragged observations have no vector form: compared as a batch, and with the team as one agent"
    _vector(copies(single[0], _COPIES), expected, actions, seeds)
    if importlib.util.find_spec("stable_baselines3") is None:
        return "not compared as an SB3 VecEnv: Stable-Baselines3 isn't installed"
    _sb3(copies(single[0], _COPIES), expected, actions, seeds[0])
    return ""


def copies(env: KHopEnv, num_envs: int, **changes: Any) -> BatchedEnv:
    """The same environment as a `BatchedEnv` of `num_envs` environments; `changes` are arguments of its `Simulator`."""
    batched, simulator = env.batched, env.batched.simulator
    arguments = {"disturbance": simulator.disturbance, "observers": simulator.observers, **changes}
    many = Simulator(simulator.design, simulator.initial, task=simulator.task_graph, num_envs=num_envs, **arguments)
    return BatchedEnv(many, batched.task, batched.settings, batched.scenario)


def _by_agent(env: KHopEnv, flat: Any) -> dict[str, Any]:
    offset = env.batched.action_offset
    return {agent: flat[offset[i] : offset[i + 1]] for i, agent in enumerate(env.possible_agents)}


def _flat(env: KHopEnv, observations: dict[str, Any], *others: dict[str, Any]) -> dict[str, Any]:
    """Return values of reset or step, concatenated over agents."""
    agents = env.possible_agents
    flat = {"observations": np.concatenate([observations[agent] for agent in agents])}
    for name, values in zip(("rewards", "terminations", "truncations"), others[:-1], strict=False):
        flat[name] = np.array([values[agent] for agent in agents])
    for key in others[-1][agents[0]]:
        flat[key] = np.array([others[-1][agent][key] for agent in agents])
    return flat


def _same(view: str, number: int, name: str, found: Any, expected: Any) -> None:
    if text := difference(np.asarray(expected).reshape(-1), np.asarray(found).reshape(-1), name):
        raise Fault(f"step {number}, single environments, then {view}: {text}")


def _rows(steps: list[dict[str, Any]], name: str) -> Any:
    return np.concatenate([step[name] for step in steps])


def _batched(env: BatchedEnv, expected: list[Any], actions: Any, seeds: list[int]) -> None:
    def same(number: int, steps: list[dict[str, Any]], observations: Any, infos: Any) -> None:
        _same("as a batch", number, "observations", observations, _rows(steps, "observations"))
        for key, values in infos.items():
            _same("as a batch", number, f"infos[{key!r}]", values, _rows(steps, key))

    same(0, [run[0] for run in expected], *env.reset(seeds))
    for number, action in enumerate(actions, start=1):
        steps = [run[number] for run in expected]
        observations, rewards, terminated, truncated, infos = env.step(action)
        same(number, steps, observations, infos)
        _same("as a batch", number, "rewards", rewards, _rows(steps, "rewards"))
        for name, flags in (("terminations", terminated), ("truncations", truncated)):
            _same("as a batch", number, name, np.repeat(flags, len(env.agents)), _rows(steps, name))
        over = [b for b, step in enumerate(steps) if "next" in step]
        if over:
            observations, infos = env.reset(env_ids=over)
            same(number, [step.get("next", step) for step in steps], observations, infos)


def _vector(batched: BatchedEnv, expected: list[Any], actions: Any, seeds: list[int]) -> None:
    env = KHopVectorEnv(batched, name="")
    _same(
        "as a vector environment",
        0,
        "observations",
        env.reset(seed=seeds)[0],
        _rows([run[0] for run in expected], "observations"),
    )
    for number, action in enumerate(actions, start=1):
        steps = [run[number] for run in expected]
        rows, *flat, infos = env.step(action.reshape(env.action_space.shape))
        after = [step.get("next", step) for step in steps]
        _same("as a vector environment", number, "observations", rows, _rows(after, "observations"))
        for name, values in zip(("rewards", "terminations", "truncations"), flat, strict=True):
            _same("as a vector environment", number, name, values, _rows(steps, name))
        over = [step for step in steps if "next" in step]
        if over:
            final = [row for row in infos["final_obs"] if row is not None]
            _same("as a vector environment", number, "final_obs", np.concatenate(final), _rows(over, "observations"))


def _joint(inner: KHopEnv, expected: list[Any], actions: Any, seed: int) -> None:
    env = JointEnv(inner)
    _same("with the team as one agent", 0, "observations", env.reset(seed=seed)[0], expected[0]["observations"])
    for number, (action, step) in enumerate(zip(actions, expected[1:], strict=True), start=1):
        observation, reward, terminated, truncated, _ = env.step(action)
        _same("with the team as one agent", number, "observations", observation, step["observations"])
        _same("with the team as one agent", number, "reward", reward, step["rewards"].mean())
        _same("with the team as one agent", number, "terminated", terminated, step["terminations"].all())
        _same("with the team as one agent", number, "truncated", truncated, step["truncations"].all())
        if "next" in step:
            _same("with the team as one agent", number, "observations", env.reset()[0], step["next"]["observations"])


def _sb3(batched: BatchedEnv, expected: list[Any], actions: Any, seed: int) -> None:
    from khop_env.env.sb3 import KHopSB3VecEnv

    env, agents = KHopSB3VecEnv(batched), len(batched.agents)
    env.seed(seed)
    _same("as an SB3 VecEnv", 0, "observations", env.reset(), _rows([run[0] for run in expected], "observations"))
    for number, action in enumerate(actions, start=1):
        steps = [run[number] for run in expected]
        rows, rewards, dones, infos = env.step(action.reshape(env.num_envs, -1))
        after = [step.get("next", step) for step in steps]
        _same("as an SB3 VecEnv", number, "observations", rows, _rows(after, "observations"))
        _same("as an SB3 VecEnv", number, "rewards", rewards, _rows(steps, "rewards").astype(np.float32))
        _same("as an SB3 VecEnv", number, "dones", dones, _rows(steps, "terminations") | _rows(steps, "truncations"))
        for row in np.flatnonzero(dones):
            step, agent = steps[row // agents], row % agents
            last = step["observations"].reshape(agents, -1)[agent]
            _same("as an SB3 VecEnv", number, "terminal_observation", infos[row]["terminal_observation"], last)
            limit = infos[row]["TimeLimit.truncated"]
            _same("as an SB3 VecEnv", number, "TimeLimit.truncated", limit, step["truncations"][agent])
