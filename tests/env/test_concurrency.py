"""Threads and processes: same bits as alone, no crash and no hang. Each test has a process of its own, which is ended
with its workers when its time is up.
"""

import contextlib
import faulthandler
import functools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest
import supersuit
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from khop_env import consensus_v0, make_vec
from tests.env.playing import built, same

LIMIT = 180.0  # s; each takes a few, and all kernels may have to be compiled
STEPS = 25
CYCLES = 10  # episodes end and begin again on the way


def apart(test):
    """Run the test in a process of its own."""
    if __name__ == "__main__":
        return test

    @functools.wraps(test)
    def run(**arguments):
        command = [sys.executable, __file__, test.__name__, json.dumps(arguments)]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
        )
        timed_out = False
        try:
            said, _ = process.communicate(timeout=LIMIT)  # until the last worker has closed its output, too
        except subprocess.TimeoutExpired:
            timed_out = True
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        if timed_out:
            pytest.fail(f"still running after {LIMIT:g} s:\n{process.communicate()[0]}")
        assert process.returncode == 0, said

    return run


def play(env, seed):
    """All that a vector environment returns, for actions from the seed."""
    rng = np.random.default_rng(seed)
    seen = [env.reset(seed=seed)]
    for _ in range(STEPS):
        seen.append(env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)))
    return seen


def episodes(seed, environment="consensus_v0", scenario="paper", copies=2, threads=1):
    """Those of a new environment; all environments of one process share the scenario and with it the observers."""
    return play(
        make_vec(
            environment,
            copies,
            autoreset_mode="same_step",
            scenario=built(scenario),
            max_cycles=CYCLES,
            threads=threads,
        ),
        seed,
    )


def joint():
    import khop_env  # noqa: F401  # a spawned worker has to

    return gymnasium.make("khop/Consensus-v0", max_cycles=CYCLES, threads=2, disable_env_checker=True)


@apart
@pytest.mark.parametrize("copies", [1, 128])  # the solve's threads share targets, or environments
@pytest.mark.parametrize(
    ("environment", "scenario"), [("consensus_v0", "paper"), ("leader_following_v0", "mixed_fleet")]
)
def test_python_threads(environment, scenario, copies):
    """Environments of one scenario, each stepped by a thread of its own, with one or two threads in the solve."""
    sys.setswitchinterval(1e-5)
    seeds = range(3)
    expected = [episodes(seed, environment, scenario, copies) for seed in seeds]
    for threads in (1, 2):
        start = threading.Barrier(len(seeds))

        def work(seed, threads=threads, start=start):
            start.wait()
            return episodes(seed, environment, scenario, copies, threads)

        with ThreadPoolExecutor(len(seeds)) as pool:
            assert same(list(pool.map(work, seeds)), expected)


@apart
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_async_vector_env(context):
    """Gymnasium's worker processes, after threads have solved in the parent."""
    episodes(0, threads=2)
    expected = SyncVectorEnv([joint] * 2)
    workers = AsyncVectorEnv([joint] * 2, context=context)
    assert same(play(workers, 3), play(expected, 3))
    workers.close()


@apart
def test_a_forked_environment_goes_on():
    """An environment whose threads were left behind in the parent continues bit for bit in the child, and the parent's
    own does so, too.
    """
    env = make_vec("consensus_v0", 2, autoreset_mode="same_step", scenario=built("paper"), max_cycles=CYCLES, threads=2)
    play(env, 0)
    ours, theirs = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=lambda: theirs.send(play(env, 1)))
    child.start()
    seen = ours.recv()
    child.join()
    expected = episodes(1)
    assert same(seen, expected)
    assert same(play(env, 1), expected)


def proceed(env, actions):
    return [env.step(one) for one in actions]


@apart
def test_spawned_workers():
    """Two at once, with environments of their own; then with one that was sent in the middle of an episode."""
    env = consensus_v0.parallel_env(built("paper"), threads=2)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = [{one: rng.uniform(-1.0, 1.0, 2).astype(np.float32) for one in env.agents} for _ in range(STEPS)]
    proceed(env, actions)
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        assert same(list(pool.map(episodes, range(4))), [episodes(seed) for seed in range(4)])
        assert same(pool.submit(proceed, env, actions).result(), proceed(env, actions))


@apart
@pytest.mark.parametrize("base_class", ["gymnasium", "stable_baselines3"])
def test_supersuit(base_class):
    """Two copies in two processes; SuperSuit starts copy b from seed + b."""
    episodes(0, threads=2)
    env = supersuit.pettingzoo_env_to_vec_env_v1(consensus_v0.parallel_env(max_cycles=CYCLES, threads=2))
    workers = supersuit.concat_vec_envs_v1(env, 2, num_cpus=2, base_class=base_class)
    processes = getattr(workers, "venv", workers)
    processes.graceful_shutdown_timeout = 0.0  # s; SuperSuit's workers never end by themselves
    expected = episodes(5)
    rng = np.random.default_rng(5)
    assert processes.reset(seed=5)[0].tobytes() == expected[0][0].tobytes()
    for observations, rewards, terminated, truncated, _ in expected[1:]:
        actions = rng.uniform(-1.0, 1.0, (workers.num_envs, 2)).astype(np.float32)
        seen, seen_rewards, *ends, _ = workers.step(actions)
        assert seen.tobytes() == observations.tobytes()
        assert same(seen_rewards, rewards.astype(np.float32))
        assert same(ends, [terminated, truncated] if base_class == "gymnasium" else [terminated | truncated])
    workers.close()


if __name__ == "__main__":
    faulthandler.dump_traceback_later(LIMIT - 10.0)
    globals()[sys.argv[1]](**json.loads(sys.argv[2]))
