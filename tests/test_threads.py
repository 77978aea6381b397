"""Threads that share a batch."""

import multiprocessing
import pickle
import threading
import time
from concurrent.futures import Future

import pytest

from khop_env.threads import Range, Threads


@pytest.mark.parametrize(("count", "size", "least"), [(1, 5, 1), (2, 5, 1), (3, 7, 1), (4, 7, 2), (8, 3, 1), (2, 0, 1)])
def test_ranges_cover_everything_once(count: int, size: int, least: int) -> None:
    ranges = Threads(count).ranges(size, least)
    assert [i for low, high in ranges for i in range(low, high)] == list(range(size))
    assert 1 <= len(ranges) <= count
    assert len(ranges) == 1 or min(high - low for low, high in ranges) >= least


def test_results_come_in_the_order_of_the_ranges_and_at_once() -> None:
    threads = Threads(3)
    meet = threading.Barrier(3, timeout=30)  # broken unless all three run at the same time

    def sum_of(part: Range) -> int:
        meet.wait()
        return sum(range(*part))

    assert threads.run(sum_of, threads.ranges(9)) == [3, 12, 21]


@pytest.mark.parametrize("failing", [0, 1])
def test_an_error_is_raised_after_all_have_ended(failing: int) -> None:
    threads, ended = Threads(2), []

    def work(part: Range) -> None:
        if part[0] == failing:
            raise ValueError(f"part {part}")
        ended.append(part)

    with pytest.raises(ValueError, match=rf"part \({failing}, {failing + 1}\)"):
        threads.run(work, threads.ranges(2))
    assert len(ended) == 1


def _total(threads: Threads, queue: "multiprocessing.Queue[int]") -> None:
    queue.put(sum(threads.run(lambda part: part[1] - part[0], threads.ranges(10))))


def test_they_survive_pickling_and_forking() -> None:
    threads = Threads(2)
    assert threads.run(lambda part: part[0], threads.ranges(4)) == [0, 2]
    copied = pickle.loads(pickle.dumps(threads))
    assert copied.run(lambda part: part[0], copied.ranges(4)) == [0, 2]
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_total, args=(threads, queue))
    child.start()
    assert queue.get(timeout=30) == 10
    child.join()


def test_ctrl_c_waits_until_all_have_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """What catches it may write to the arrays that threads write to."""
    threads, ended, go_on = Threads(2), [], threading.Event()
    waited = Future.exception

    def interrupted(future: "Future[None]", timeout: float | None = None) -> BaseException | None:
        if go_on.is_set():
            return waited(future, timeout)
        go_on.set()
        raise KeyboardInterrupt

    def work(part: Range) -> None:
        if part[0]:
            go_on.wait(30)
            time.sleep(0.05)
            ended.append(part)

    monkeypatch.setattr(Future, "exception", interrupted)
    with pytest.raises(KeyboardInterrupt):
        threads.run(work, threads.ranges(2))
    assert ended == [(1, 2)]
