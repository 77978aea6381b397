"""Recorded episodes: what the environment gave, to the bit; the same files however they are made."""

import json
import shlex
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal
from typer.testing import CliRunner

import khop_env
from agents import RandomPolicy, compare, evaluate
from agents.workers import Interrupted, UnfinishedError
from khop_env.cli import app
from khop_env.env.actuators import SlewLimit
from khop_env.network import RandomLinks
from khop_env.registry import make_batched, scenario
from khop_env.results import EpisodeDataset, episodes

SMALL = Path(__file__).parents[2] / "examples" / "data" / "khop_small"
CHANGING = scenario("paper").replace(schedule=RandomLinks(0.7))


def read(folder, table):
    return pl.read_parquet(folder / table / "*.parquet")


def about(folder):
    return json.loads((folder / "dataset.json").read_text())


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*.parquet"))}


def khop(*arguments, status=0):
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == status, (result.stdout, result.stderr, result.exception)
    return result


@pytest.mark.parametrize(
    ("environment", "name", "policy", "arguments"),
    [
        ("leader_following_v0", "mixed_fleet", "leader_following", {"bounds": True}),
        ("leader_following_v0", "convoy", "random", {"uniform": False, "actuator": SlewLimit(), "dt": 0.01}),
        ("consensus_v0", CHANGING, "tanh", {"observe": "local"}),
        ("consensus_v0", "paper", "tanh", {"network": "lossy:loss=0.4", "success_radius": 1.2}),
        ("navigation_v0", "crossing:agents=4", "filter:announce=true:keep_right", {"network": "wifi"}),
        ("navigation_v0", "swap", "bang_bang", {"network": "wifi", "end_at_collision": True, "observe": "oracle"}),
    ],
)
def test_a_recording_is_what_the_environment_gave(tmp_path, environment, name, policy, arguments):
    arguments = {"max_cycles": 25, **arguments}
    observe = arguments.pop("observe", "estimate")
    seeds = [5, 3, 11]
    compare(environment, [policy], [observe], scenario=name, seeds=seeds, arguments=arguments, record=tmp_path)
    described = about(tmp_path)
    needed = {key: described["evaluations"][0]["arguments"][key] for key in ("bounds", "message_size")
              if key in described["evaluations"][0]["arguments"]}  # fmt: skip
    env = make_batched(environment, name, observe=observe, **{**arguments, **needed})
    fleet, simulator = env.fleet, env.simulator
    layout = simulator.observers.layout
    steps, estimates = read(tmp_path, "steps"), read(tmp_path, "estimates")
    assert steps["seed"].unique(maintain_order=True).to_list() == seeds
    layouts = [described["layouts"][k] for k in described["evaluations"][0]["observations"].values()]
    assert layouts == [list(each.names) for each in env.layouts]
    lengths = []
    for seed in seeds:
        observations, _ = env.reset([seed])
        rows = steps.filter(seed=seed).partition_by("step", maintain_order=True)
        known = estimates.filter(seed=seed).partition_by("step", maintain_order=True)
        assert len(rows) == len(known)
        for number, (own, others) in enumerate(zip(rows, known, strict=True)):
            assert own["agent"].to_list() == list(fleet.ids)
            assert set(own["step"]) == {number} == set(others["step"])
            assert set(own["time"]) == {simulator.t[0]} == set(others["time"])
            flat = observations.reshape(-1)
            for i, agent in enumerate(fleet.ids):
                row = own.row(i, named=True)
                state = [row[f"state.{each}"] for each in fleet.models[i].states]
                np.testing.assert_array_equal(state, simulator.x[0, fleet.state_slice(i)])
                if agent in env.agents:
                    k = env.agents.index(agent)
                    seen = [row[f"obs.{each}"] for each in env.layouts[k].names]
                    end = slice(*env.observation_offset[k : k + 2])
                    np.testing.assert_array_equal(np.array(seen, np.float32), flat[end])
                else:
                    assert {row[each] for each in own.columns if each.startswith(("obs.", "action.", "reward"))} == {
                        None
                    }
            np.testing.assert_array_equal(others["state"], simulator.x[0, layout.column_source])
            np.testing.assert_array_equal(others["estimate"], simulator.estimates[0])
            np.testing.assert_array_equal(others["bound"], simulator.error_bounds().bound[:, 0])
            assert others["observer"].to_list() == [fleet.ids[i] for i in layout.observer[layout.column_pair]]
            names = [fleet.component_names()[c] for c in layout.column_source]
            assert list(zip(others["target"], others["component"], strict=True)) == [(a, b) for a, b, _ in names]
            if simulator.observers.by_messages:
                information = simulator.observers.information(simulator.state)
                np.testing.assert_array_equal(others["age"], information.age[layout.column_pair, 0])
                np.testing.assert_array_equal(others["hops"], information.hops[layout.column_pair, 0])
                assert others["valid"].to_list() == np.isfinite(information.age[layout.column_pair, 0]).tolist()
                if observe == "estimate":
                    _require_as_observed(env, others, observations)
            if number == len(rows) - 1:
                assert own.select("terminated", "truncated", "reward").null_count().row(0) == (len(fleet),) * 3
                break
            action = np.zeros(env.action_offset[-1])
            for k, agent in enumerate(env.agents):
                row = own.row(fleet.agent(agent), named=True)
                inputs = list(fleet.models[fleet.agent(agent)].inputs)
                said = [row[f"action.message.{c}"] for c in range(env.settings.message_size)]
                first, end = env.action_offset[k : k + 2]
                action[first : first + len(inputs)] = [row[f"action.{each}"] for each in inputs]
                action[end - len(said) : end] = said
            observations, reward, terminated, truncated, infos = env.step(action[None])
            acting = own.filter(pl.col("agent").cast(str).is_in(env.agents))
            np.testing.assert_array_equal(acting["reward"], reward[0])
            for each in ("task_error", "cost", "arrived", "min_distance"):
                assert (f"info.{each}" in own.columns) == (each in infos)
                if each in infos:
                    np.testing.assert_array_equal(acting[f"info.{each}"], infos[each][0])
            assert set(own["terminated"]) == {bool(terminated[0])}
            assert set(own["truncated"]) == {bool(truncated[0])}
            for i in range(len(fleet)):
                forced = [own[f"input.{each}"][i] for each in fleet.models[i].inputs]
                np.testing.assert_array_equal(forced, simulator.u[0, fleet.input_slice(i)])
        assert env.over[0]
        lengths.append(len(rows) - 1)
    assert described["complete"] is True
    assert described["rows"] == {"steps": steps.height, "estimates": estimates.height}
    assert steps.height == sum(length + 1 for length in lengths) * len(fleet)
    if environment == "consensus_v0" and "success_radius" in arguments:
        assert len(set(lengths)) > 1  # ends at different times are among these cases


def _require_as_observed(env, others, observations):
    """Whether something has arrived, and how old it is, as agents observe it."""
    flat = observations.reshape(len(env.agents), -1)
    for k, layout in enumerate(env.layouts):
        for number, slot in enumerate(layout.slots):
            row = others.filter(observer=layout.agent, target=slot.id).row(0, named=True)
            for name in ("valid", "heard", "hops"):
                assert flat[k, layout.index(f"slot{number}.{name}")] == row[name]
            if row["valid"]:
                assert flat[k, layout.index(f"slot{number}.age")] == np.float32(row["age"])


def test_recording_changes_nothing_and_workers_change_no_file(tmp_path):
    played = {
        "policies": ["go_to_goal", "filter", "random"],
        "scenario": "crossing:agents=4",
        "networks": ["wifi", "lossy:loss=0.3"],
        "arguments": {"max_cycles": 8},
        "seeds": range(30),
    }
    found = [compare("navigation_v0", **played)]
    found += [compare("navigation_v0", **played, record=tmp_path / str(n), workers=n) for n in (1, 2)]
    assert found[0].summary() == found[1].summary() == found[2].summary()
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert len(contents(tmp_path / "1")) == 2 * 3 * 2 * 2  # tables, policies, networks, batches of 25 episodes
    assert about(tmp_path / "1") == about(tmp_path / "2")
    steps = read(tmp_path / "1", "steps")
    keys = ["policy", "observe", "network", "seed", "step", "agent"]
    assert steps.select(keys).n_unique() == steps.height
    assert steps.select("policy", "network").n_unique() == 6
    assert steps.filter(policy="go_to_goal")["obs.slot0.bound.x"].null_count() > 0  # only filters observe bounds
    returns = steps.group_by("policy", "network", "seed", "agent").agg(pl.col("reward").sum())
    mean = returns.filter(policy="filter", network="wifi")["reward"].mean()
    row = found[0].summary()["rows"][2]
    assert (row["policy"], row["network"]) == ("filter", "wifi")
    assert mean == pytest.approx(row["mean_return"])


def test_from_python(tmp_path):
    """Of an environment that exists, and with a policy of one's own."""
    env = khop_env.make_batched("consensus_v0", num_envs=2, max_cycles=5)
    policies = {"mine": RandomPolicy(), "other": RandomPolicy()}
    frame = evaluate(env, policies, range(3), record=tmp_path / "new" / "folder")
    assert_frame_equal(frame, evaluate(env, policies, range(3)))
    steps = read(tmp_path / "new" / "folder", "steps")
    assert steps.height == 2 * 3 * 6 * 8
    assert steps.filter(seed=2).height == 2 * 6 * 8  # the last batch is filled up with copies, which aren't recorded
    with pytest.raises(ValueError, match=r"isn't an empty folder, and a recording overwrites nothing: name a new"):
        evaluate(env, policies, range(3), record=tmp_path / "new" / "folder")
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(ValueError, match="isn't an empty folder"):
        EpisodeDataset(file)


def test_parts_hold_the_same_rows(tmp_path, monkeypatch):
    """Large fleets are written in parts, so that memory is bounded."""
    played = {"policies": ["random"], "seeds": range(3), "arguments": {"max_cycles": 30, "success_radius": 1.4}}
    compare("consensus_v0", **played, record=tmp_path / "whole")
    monkeypatch.setattr(episodes, "MOST_NUMBERS", 4000)
    compare("consensus_v0", **played, record=tmp_path / "parts")
    assert len(contents(tmp_path / "parts")) > 10
    for table in ("steps", "estimates"):
        parts = read(tmp_path / "parts", table).sort("seed", "step", maintain_order=True)
        assert_frame_equal(parts, read(tmp_path / "whole", table))


@pytest.mark.parametrize("after", [1, 3])
def test_what_is_finished_is_kept(tmp_path, after):
    calls = []

    def progress(_):
        calls.append(0)
        if len(calls) == after:
            raise KeyboardInterrupt

    played = {"policies": ["zero", "random"], "seeds": range(50), "arguments": {"max_cycles": 3}}
    with pytest.raises(Interrupted) as caught:
        compare("consensus_v0", **played, record=tmp_path / "cut", progress=progress)
    compare("consensus_v0", **played, record=tmp_path / "whole")
    found, whole = contents(tmp_path / "cut"), contents(tmp_path / "whole")
    assert len(found) == 2 * after
    assert all(whole[name] == data for name, data in found.items())
    assert about(tmp_path / "cut")["complete"] is False
    assert about(tmp_path / "cut")["rows"]["steps"] == read(tmp_path / "cut", "steps").height
    assert sum(len(row.episodes.seed) for row in caught.value.partial.rows) == 25 * after
    assert not list(tmp_path.rglob(".*"))


def test_a_full_disk_loses_no_result(tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left")

    dataset = EpisodeDataset(tmp_path)
    monkeypatch.setattr(dataset, "write", full)
    with pytest.raises(UnfinishedError, match="no space left"):
        compare("consensus_v0", ["zero"], seeds=range(2), arguments={"max_cycles": 2}, record=dataset)


def test_the_command(tmp_path):
    command = "evaluate", "leader_following_v0", "--policies", "random", "--observe", "estimate", "--episodes", "2"
    command += "--env", "max_cycles=4", "--json"
    plain = khop(*command)
    recorded = khop(*command, "--record", str(tmp_path / "new"))
    assert recorded.stdout == plain.stdout
    assert f"recorded: {tmp_path / 'new'}, 80 rows of steps and 520 of estimates, " in recorded.stderr
    assert about(tmp_path / "new")["command"] == shlex.join(
        ["khop", *command[:8], "--seed", "0", "--record", str(tmp_path / "new"), "--env", "max_cycles=4"]
    )
    said = khop(*command, "--record", str(tmp_path / "new"), status=2)
    assert "isn't an empty folder" in said.stderr
    assert said.stdout == ""
    assert "name its folder with --record DIR" in khop(*command, "--minari", "khop/mine-v0", status=2).stderr
    several = [*command[:4], "--record", str(tmp_path / "other"), "--minari", "khop/mine-v0"]
    assert "is of one environment: choose one mode with --observe" in khop(*several, status=2).stderr
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("name", ["leader_following", "navigation"])
def test_the_shipped_data_set_is_what_its_command_gives(tmp_path, name):
    """To 1e-9 here, since processors and libraries round differently; to the bit by the command on one machine."""
    shipped = SMALL / name
    described = about(shipped)
    assert described["complete"] is True
    command = shlex.split(described["command"])
    assert command[0] == "khop"
    for option, value in (("--episodes", "1"), ("--record", str(tmp_path / "now")), ("--network", "wifi")):
        command[command.index(option) + 1] = value
    khop(*command[1:])
    for table in ("steps", "estimates"):
        old, new = read(shipped, table), read(tmp_path / "now", table)
        first = old.filter(seed=0, network="wifi")
        now = new.with_columns(pl.lit("wifi").cast(pl.Categorical).alias("network"))
        assert first.schema == now.schema
        for column, kind in first.schema.items():
            if kind.is_float():
                np.testing.assert_allclose(now[column], first[column], rtol=1e-9, atol=1e-9, err_msg=column)
            else:
                assert now[column].to_list() == first[column].to_list(), column
        assert described["rows"][table] == old.height
        assert list(described["columns"][table]) == old.columns
    assert sum(path.stat().st_size for path in SMALL.rglob("*")) < 5e6


def test_minari_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    command = "evaluate", "consensus_v0", "--policies", "zero", "--observe", "estimate", "--record", str(tmp_path / "a")
    said = khop(*command, "--minari", "khop/mine-v0", status=2).stderr
    assert "a Minari data set needs Minari: in a clone of khop_env, pip install -c" in said
    assert "-e '.[minari]'" in said
    assert not (tmp_path / "a").exists()


class TestMinari:
    @pytest.fixture(autouse=True)
    def minari(self, tmp_path, monkeypatch):
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
        return pytest.importorskip("minari", reason="the extra minari isn't installed")

    def test_it_is_the_joint_environment(self, tmp_path, minari):
        command = "evaluate", "leader_following_v0", "--policies", "random,bang_bang", "--observe", "estimate"
        command += "--network", "wifi", "--episodes", "2", "--env", "max_cycles=6", "--env", "bounds=true"
        said = khop(*command, "--record", str(tmp_path / "a"), "--minari", "khop/mine-v0").stderr
        assert "minari: khop/mine-v0, 4 episodes and 24 steps" in said
        found = minari.load_dataset("khop/mine-v0")
        env = found.recover_environment()
        assert env.observation_space == found.observation_space
        assert env.action_space == found.action_space
        for number, episode in enumerate(found.iterate_episodes()):
            observation, _ = env.reset(seed=number % 2)
            np.testing.assert_array_equal(observation, episode.observations[0])
            assert episode.observations[0].dtype == np.float32
            for step, action in enumerate(episode.actions):
                assert action in env.action_space
                observation, reward, *over, _ = env.step(action)
                np.testing.assert_array_equal(observation, episode.observations[step + 1])
                assert reward == episode.rewards[step]
                assert over == [episode.terminations[step], episode.truncations[step]]
        assert (
            "already: choose another name"
            in khop(*command, "--record", str(tmp_path / "b"), "--minari", "khop/mine-v0", status=2).stderr
        )
        assert (
            "isn't the name of a Minari data set"
            in khop(*command, "--record", str(tmp_path / "b"), "--minari", "a b", status=2).stderr
        )

    def test_an_environment_that_can_t_be_made_again_is_refused(self, tmp_path):
        from khop_env.results.minari_dataset import write_minari

        changed = scenario("paper").replace(radius=0.5 * scenario("paper").radius)
        played = {"policies": ["zero"], "seeds": [0], "arguments": {"max_cycles": 3}}
        compare("consensus_v0", **played, scenario=changed, record=tmp_path / "changed")
        with pytest.raises(ValueError, match="plays its first episode otherwise"):
            write_minari(tmp_path / "changed", "mine-v0")
        compare("consensus_v0", **played, scenario=changed.replace(name="mine"), record=tmp_path / "unknown")
        with pytest.raises(ValueError, match=r"can't be made by its names and arguments alone: no scenario 'mine'"):
            write_minari(tmp_path / "unknown", "mine-v0")
        compare("consensus_v0", ["zero"], ["estimate", "local"], seeds=[0], record=tmp_path / "two")
        with pytest.raises(ValueError, match="this recording is of 2"):
            write_minari(tmp_path / "two", "mine-v0")
