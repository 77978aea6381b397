"""Recorded episodes as a Minari data set: of the whole team as one agent, for offline reinforcement learning."""

from __future__ import annotations

import copy
import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

import khop_env
from khop_env.catalog import ENVIRONMENTS, gymnasium_id
from khop_env.extras import how_to_install
from khop_env.results.data_columns import action_names
from khop_env.results.dataset import DESCRIPTION

if TYPE_CHECKING:
    import polars as pl

_SOURCE = "https://github.com/khop-env/khop_env"


def require_new(name: str) -> None:
    """Refuse the name of a Minari data set that couldn't be written.

    Args:
        name: e.g. "khop/convoy/tuned-v0".

    Raises:
        ModuleNotFoundError: if Minari isn't installed; the message says what to type.
        ValueError: if it isn't a name, or there is such a data set.
    """
    minari = _minari()
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        parse_dataset_id(name)
    except ValueError:
        raise ValueError(f"{name!r} isn't the name of a Minari data set; expected e.g. khop/convoy/tuned-v0") from None
    if name in minari.list_local_datasets():
        raise ValueError(f"there is a Minari data set {name!r} already: choose another name or version")


def write_minari(folder: str | Path, name: str) -> Any:
    """Write a recording as a Minari data set, which `minari.load_dataset(name)` loads.

    Observations, actions and rewards are those of the joint environment, `gymnasium.make("khop/...")`, which
    `recover_environment()` makes: all acting agents' side by side, the mean of the rewards; actions are clipped to
    [-1, 1]. The first episode is played again in that environment, and has to be the same to the bit.

    Args:
        folder: that `khop evaluate --record` or `agents.evaluate(..., record=...)` wrote.
        name: of the data set.

    Returns:
        The `minari.MinariDataset`.

    Raises:
        FileNotFoundError: if there is no recording in the folder.
        ModuleNotFoundError: if Minari isn't installed; the message says what to type.
        ValueError: for a wrong name or one that is taken, a recording of several environments, or one of an environment
            that can't be made again by its name and arguments.
    """
    minari = _minari()
    require_new(name)
    about = json.loads((Path(folder) / DESCRIPTION).read_text(encoding="utf-8"))
    env = _recovered(about)
    written = None
    for batch in _batches(Path(folder), env):
        if written is not None:
            written.update_dataset_from_buffer(batch)
            continue
        _require_same(env, batch[0])
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=UserWarning, module="minari")  # it misses an author's address
            written = minari.create_dataset_from_buffers(
                dataset_id=name,
                buffer=batch,
                env=env.spec,
                observation_space=env.observation_space,
                action_space=env.action_space,
                algorithm_name=", ".join(dict.fromkeys(each["policy"] for each in about["evaluations"])),
                code_permalink=_SOURCE,
                description=about["command"] or f"{about['environment']} on {about['scenario']}",
                requirements=[f"khop_env=={about['khop_env']}"],
            )
    if written is None:
        raise ValueError(f"{folder} has no episodes")
    return written


def _minari() -> Any:
    try:
        import minari
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"a Minari data set needs Minari: {how_to_install('minari')}") from error
    return minari


def _recovered(about: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    """The environment of a recording, made from its description."""
    several = {json.dumps(each["arguments"], sort_keys=True) for each in about["evaluations"]}
    if len(several) > 1:
        played = {f"{each['observe']} over {each['network']}" for each in about["evaluations"]}
        raise ValueError(
            f"a Minari data set is of one environment, and this recording is of {len(several)} "
            f"({', '.join(sorted(played))}): record one observation mode and network, policies that need no other "
            "arguments, and try again"
        )
    name, arguments = about["environment"], {"scenario": about["scenario"], **about["evaluations"][0]["arguments"]}
    if name in ENVIRONMENTS:
        spec = copy.deepcopy(gymnasium.spec(gymnasium_id(name)))
    else:
        spec = EnvSpec("khop/Own-v0", "khop_env.registry:make_joint", kwargs={"environment": name})
    spec.kwargs |= arguments
    try:
        return gymnasium.make(spec)
    except (TypeError, ValueError) as error:
        raise ValueError(_unrecovered(about, str(error))) from error


def _unrecovered(about: dict[str, Any], why: str) -> str:
    return (
        f"a Minari data set names its environment, so that others can make it again, and {about['environment']} on "
        f"{about['scenario']!r} can't be made by its names and arguments alone: {why}"
    )


def _batches(folder: Path, env: gymnasium.Env[Any, Any]) -> Iterator[list[Any]]:
    """The episodes of each policy and batch; a batch may be in several files."""
    import polars as pl
    from minari.data_collector.episode_buffer import EpisodeBuffer

    batches: dict[str, list[Path]] = {}
    for path in sorted((folder / "steps").glob("*.parquet")):
        batches.setdefault(path.stem.partition("-")[0], []).append(path)
    for paths in batches.values():
        table = pl.concat([pl.read_parquet(path) for path in paths]).sort("seed", "step", maintain_order=True)
        yield [_episode(EpisodeBuffer, rows, env) for rows in table.partition_by("seed", maintain_order=True)]


def _episode(buffer: Any, rows: pl.DataFrame, env: gymnasium.Env[Any, Any]) -> Any:
    """An episode of the joint environment from the rows of all agents."""
    batched = env.unwrapped.env.batched  # type: ignore[attr-defined]
    by_agent = {str(agent): own for (agent,), own in rows.group_by("agent")}
    own = [by_agent[agent] for agent in batched.agents]
    observations, actions = [], []
    for frame, layout, names in zip(own, batched.layouts, action_names(batched), strict=True):
        observations.append(frame.select(f"obs.{name}" for name in layout.names).to_numpy())
        moves = np.zeros((frame.height - 1, len(names)))
        for c, name in enumerate(names):
            if name:
                moves[:, c] = frame[f"action.{name}"].to_numpy()[:-1]
        actions.append(np.clip(moves, -1.0, 1.0).astype(np.float32))
    rewards = np.array([frame["reward"].to_numpy()[:-1] for frame in own]).T.copy()
    return buffer(
        seed=int(rows["seed"][0]),
        observations=np.hstack(observations),
        actions=np.hstack(actions),
        rewards=[float(each.mean()) for each in rewards],
        terminations=own[0]["terminated"].to_list()[:-1],
        truncations=own[0]["truncated"].to_list()[:-1],
    )


def _require_same(env: gymnasium.Env[Any, Any], episode: Any) -> None:
    """Play an episode again.

    Raises:
        ValueError: if it isn't the same to the bit.
    """
    observation, _ = env.reset(seed=episode.seed)
    same, step = np.array_equal(observation, episode.observations[0]), 0
    while same and step < len(episode.actions):
        observation, reward, terminated, truncated, _ = env.step(episode.actions[step])
        now = reward, terminated, truncated
        same = np.array_equal(observation, episode.observations[step + 1])
        same &= now == (episode.rewards[step], episode.terminations[step], episode.truncations[step])
        step += 1
    if not same:
        raise ValueError(
            "the environment that the recording names plays its first episode otherwise "
            f"(seed {episode.seed}, step {step}): its scenario or task was an object that was changed, or it was "
            f"recorded by another version than {khop_env.__version__}"
        )
