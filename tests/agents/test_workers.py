"""Several processes: they end with the caller, their death is detected, and results until then are kept."""

import contextlib
import dataclasses
import io
import json
import math
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from agents import ZeroPolicy, compare, interval95, tune
from agents.policy import policy_seeds
from agents.set_iss import injected_errors, swept_bounds
from agents.workers import Interrupted, UnfinishedError, WorkerError, run_in_processes
from khop_env.cli import app
from khop_env.commands.evaluate import print_comparison
from khop_env.registry import scenario
from khop_env.scenarios.export import write_scenario
from tests.env.playing import batched

ROOT = Path(__file__).parents[2]


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


def doing(task):
    """The function that workers run in these tests."""
    what, value = task
    if what == "wait":
        time.sleep(600)
    if what == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "leave":
        os._exit(value)
    if what == "fail":
        raise ValueError(f"no {value}")
    return os.getpid()


def test_every_task_is_done_once():
    found = dict(run_in_processes(doing, [("pid", q) for q in range(20)], 2))
    assert sorted(found) == list(range(20))
    assert len(set(found.values()) - {os.getpid()}) == 2
    assert not any(alive(pid) for pid in found.values())
    with pytest.raises(ValueError, match="no luck"):
        list(run_in_processes(doing, [("fail", "luck"), ("wait", 0)], 2))
    with pytest.raises(ValueError, match="can't be sent to other processes; use workers=1"):
        list(run_in_processes(lambda task: task, [1], 2))


@pytest.mark.parametrize(
    ("task", "said"),
    [
        (("die", 0), "a worker process was killed by SIGKILL"),
        (("leave", 3), r"a worker process ended with status 3 \(a script"),
    ],
)
def test_a_killed_worker_is_noticed(task, said):
    results = []
    with pytest.raises(WorkerError, match=said):
        results.extend(result for result in run_in_processes(doing, [("pid", 0), ("pid", 1), task, ("wait", 0)], 2))
    assert len(results) <= 2


def test_workers_end_where_nobody_waits_for_them():
    results = run_in_processes(doing, [("pid", 0), ("pid", 1), ("wait", 0), ("wait", 0)], 2)
    pids = {pid for _, (_, pid) in zip(range(2), results, strict=False)}
    assert all(alive(pid) for pid in pids)
    results.close()
    assert not any(alive(pid) for pid in pids)


def test_comparisons_in_threads_are_those_of_one_thread():
    """Each comparison has environments of its own."""
    calls = [{"policies": [law], "seeds": range(12), "observe": [mode]} for law in ("tanh", "random", "linear")
             for mode in ("estimate", "local")]  # fmt: skip
    alone = [compare("consensus_v0", **call, arguments={"max_cycles": 60}).summary() for call in calls]
    with ThreadPoolExecutor(6) as threads:
        found = list(threads.map(lambda call: compare("consensus_v0", **call, arguments={"max_cycles": 60}), calls))
    assert [comparison.summary() for comparison in found] == alone


def test_an_edited_scenario_file_is_read_again(tmp_path):
    path, found = tmp_path / "edited.toml", []
    for radius in (1.0, 0.25):
        chosen = scenario("paper")
        chosen = chosen.replace(name="edited", radius=radius * chosen.radius)
        path.write_text(write_scenario(chosen))
        asked = {"policies": ["zero"], "seeds": range(2), "arguments": {"max_cycles": 3}}
        found.append(compare("consensus_v0", scenario=path, **asked).summary())
        assert found[-1] == compare("consensus_v0", scenario=chosen, **asked).summary()
    assert found[0]["rows"] != found[1]["rows"]


def interrupting(after):
    """A progress callback that raises KeyboardInterrupt at its n-th call."""
    calls = []

    def progress(_):
        calls.append(0)
        if len(calls) == after:
            raise KeyboardInterrupt

    return progress


def test_what_was_played_is_kept():
    """Finished rows, and the first episodes of others, equal to those of an uninterrupted comparison."""
    call = {"policies": ["tanh", "zero"], "observe": ["local"], "seeds": range(60), "arguments": {"max_cycles": 4}}
    whole = compare("consensus_v0", **call)
    with pytest.raises(Interrupted) as caught:
        compare("consensus_v0", **call, progress=interrupting(5))
    partial = caught.value.partial
    assert [len(row.episodes.seed) for row in partial.rows] == [60, 50]
    assert [row.get("episodes") for row in partial.summary()["rows"]] == [None, 50]
    assert partial.rows[0].summary() == whole.rows[0].summary()
    assert (
        partial.frame()
        .filter(pl.col("policy") == "zero")
        .equals(whole.frame().filter(pl.col("policy") == "zero", pl.col("seed") < 50))
    )
    more = whole.rows[1].episodes.returns[:50] - whole.rows[0].episodes.returns[:50]
    assert partial.difference(partial.rows[1])[0] == more.mean()
    assert isinstance(caught.value, KeyboardInterrupt)


class Waiting(ZeroPolicy):
    """Never begins the episode with seed 0."""

    def reset(self, env, seeds):
        if policy_seeds([0])[0] in seeds and multiprocessing.parent_process() is not None:
            time.sleep(600)
        super().reset(env, seeds)


def test_episodes_after_a_missing_one_are_kept(capsys):
    """A worker may be interrupted in its first episodes when another one has played all that follow."""
    policies = [f"{__file__}:Waiting", "tanh"]
    call = {"observe": ["local"], "seeds": range(75), "arguments": {"max_cycles": 4}}
    waiting, tanh = (row.episodes.returns for row in compare("consensus_v0", policies, **call).rows)
    with pytest.raises(Interrupted) as caught:
        compare("consensus_v0", policies, **call, workers=2, progress=interrupting(4))
    partial = caught.value.partial
    assert [row.episodes.seed.tolist() for row in partial.rows] == [[*range(25, 75)], [*range(50)]]
    np.testing.assert_array_equal(partial.rows[0].episodes.returns, waiting[25:])
    np.testing.assert_array_equal(partial.rows[1].episodes.returns, tanh[:50])
    more = tanh[25:50] - waiting[25:50]
    assert partial.difference(partial.rows[1]) == (more.mean(), interval95(more))
    (other,) = compare("consensus_v0", ["tanh"], **{**call, "seeds": range(25)}).rows
    assert math.isnan(partial.difference(other)[0])  # no episode was played by both
    print_comparison(dataclasses.replace(partial, rows=[partial.rows[0], other]))
    table = capsys.readouterr().out
    assert "(50 episodes)" in table
    assert "nan" not in table


def test_tuning_and_measuring_keep_what_they_found():
    env = batched("consensus_v0", "paper", num_envs=4, max_cycles=40)
    with pytest.raises(Interrupted) as caught:
        tune(env, "leader_following", range(4), progress=interrupting(1))
    assert caught.value.partial.mean_return > caught.value.partial.default_return
    short = scenario("paper").replace(duration=0.5)
    rows = injected_errors(short, sizes=(0.1, 0.2), episodes=1)
    with pytest.raises(Interrupted) as caught:
        injected_errors(short, sizes=(0.1, 0.2), episodes=1, progress=interrupting(2))
    assert caught.value.partial == rows[:3]
    with pytest.raises(Interrupted) as caught:
        swept_bounds(short, factors=(1.0, 0.5), episodes=1, progress=interrupting(3))
    assert [row["factor"] for row in caught.value.partial] == [1.0, 0.5, 1.0]


COMMAND = """
import sys
from khop_env.terminal import Progress
Progress.__call__ = lambda self, fraction: print(f"at {fraction}", file=sys.stderr, flush=True)
from khop_env.cli import main
main()
"""


def children(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


EVALUATE = ("evaluate", "consensus_v0", "--policies", "zero", "--observe", "estimate", "--episodes", "100000")


@pytest.mark.parametrize(
    ("arguments", "calls", "printed", "said"),
    [
        (
            (*EVALUATE, "--workers", "2", "--json"),
            3,
            '"episodes": ',
            "interrupted; above are the episodes that were played",
        ),
        (
            (*EVALUATE, "--csv"),
            2,
            "consensus_v0,paper,estimate,zero,49,",
            "interrupted; above are the episodes that were played",
        ),
        (
            ("tune", "consensus_v0", "--policies", "leader_following"),
            2,
            "}  # interrupted\n",
            "above are the parameters that were found until then",
        ),
        (
            ("iss", "paper", "--duration", "3", "--episodes", "2"),
            5,
            "0.02 ",
            "above are the rows that were measured until then",
        ),
    ],
    ids=["workers", "evaluate", "tune", "iss"],
)
def test_ctrl_c_on_the_command_line(tmp_path, arguments, calls, printed, said):
    """Sent to the whole process group, as by a terminal: a table, a message, status 130, and no process is left."""
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", COMMAND, *arguments],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    progress = iter(process.stderr.readline, "")
    lines = [next(line for line in progress if line.startswith("at ")) for _ in range(calls)]
    workers = children(process.pid) if Path("/proc/self/task").exists() else []
    with contextlib.ExitStack() as stack:
        stack.callback(process.kill)
        os.killpg(process.pid, signal.SIGINT)
        stdout, stderr = process.communicate(timeout=60)
    assert len(lines) == calls
    assert process.returncode == 130, stderr
    assert printed in stdout
    stderr = "".join(line for line in io.StringIO(stderr) if not line.startswith("at "))
    assert stderr.endswith(said + (" until then\n" if said.endswith("played") else "\n"))
    assert "Traceback" not in stderr
    deadline = time.monotonic() + 10.0  # Python's own resource tracker goes a moment after its parent
    while any(alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in workers)
    assert len(workers) >= (2 if "--workers" in arguments else 0)
    if "--json" in arguments:
        assert json.loads(stdout)["rows"][0]["episodes"] % 25 == 0


def test_a_killed_worker_on_the_command_line(monkeypatch):
    """One line, status 2, and the rows until then."""

    calls = []

    def kill(*_):
        calls.append(None)
        if len(calls) == 2:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)

    monkeypatch.setattr("khop_env.commands.evaluate.Progress.__call__", kill)
    result = CliRunner().invoke(app, [*EVALUATE, "--workers", "2"])
    assert result.exit_code == 2
    assert result.stderr == (
        "khop: a worker process was killed by SIGKILL (use fewer workers if memory is short); above are the episodes "
        "that were played until then\n"
    )
    assert re.search(r"^zero on estimate .*^\(\d+ episodes\) ", result.stdout, re.DOTALL | re.MULTILINE)


def test_a_policy_that_fails_on_the_way(monkeypatch):
    """The message has its error, and the rows before it are kept."""
    played = []

    def play(env, policy, seeds, *, name):
        if len(played) == 2:
            raise ValueError(f"policy {name!r} stumbled")
        played.append(seeds)
        from agents.evaluation import play as real

        return real(env, policy, seeds, name=name)

    monkeypatch.setattr("agents.comparison.play", play)
    with pytest.raises(UnfinishedError, match="policy 'zero' stumbled") as caught:
        compare("consensus_v0", ["tanh", "zero"], ["local", "oracle"], seeds=range(2), arguments={"max_cycles": 2})
    assert [row.label for row in caught.value.partial.rows] == ["tanh on local", "tanh on oracle"]
    monkeypatch.undo()
