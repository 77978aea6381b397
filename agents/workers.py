"""The same work in several processes of this machine, which end with the caller, however that ends."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any

from khop_env.own_agents import call_pickled


class WorkerError(RuntimeError):
    """A worker process ended before its work did."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C.

    Attributes:
        partial: what there was until then, in the form of what would have been returned.
    """

    def __init__(self, partial: Any) -> None:
        super().__init__()
        self.partial = partial


class UnfinishedError(RuntimeError):
    """Something failed on the way; the message says what, and `__cause__` is the error itself.

    Attributes:
        partial: what there was until then, in the form of what would have been returned.
    """

    def __init__(self, message: str, partial: Any) -> None:
        super().__init__(message)
        self.partial = partial


def run_in_processes(function: Callable[[Any], Any], tasks: Sequence[Any], workers: int) -> Iterator[tuple[int, Any]]:
    """Number and result of each task, as they come.

    Whoever stops asking for results, by an exception or `close()`, ends the workers in the middle of their tasks.

    Args:
        function: what to run; each worker gets a copy of its own, once.
        tasks: its arguments.
        workers: how many processes.

    Raises:
        WorkerError: if a worker is killed, or can't start.
        ValueError: if `function` can't be sent to them.
        Exception: what `function` raises for a task.
    """
    waiting, pool = iter(enumerate(tasks)), dict[Connection, SpawnProcess]()
    try:
        pickled = bytes(ForkingPickler.dumps((_serve, function)))
    except Exception as error:  # pickle raises all kinds
        raise ValueError(f"this can't be sent to other processes, take one worker ({error})") from error
    try:
        with _sigint_blocked():
            for _ in range(min(workers, len(tasks))):
                connection, process = _started(pickled)
                pool[connection] = process
        running = {connection: _assign(connection, waiting) for connection in pool}
        while busy := [connection for connection, number in running.items() if number is not None]:
            for connection in set(busy).intersection(wait(busy)):
                number, result = running[connection], _received(connection, pool[connection])
                running[connection] = _assign(connection, waiting)
                assert number is not None
                yield number, result
    finally:
        for process in pool.values():
            process.kill()  # they have nothing to tidy up
        for connection, process in pool.items():
            process.join()
            connection.close()


def _started(pickled: bytes) -> tuple[Connection, SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=call_pickled, args=(pickled, theirs), daemon=True)
    process.start()
    theirs.close()
    return ours, process


def _assign(connection: Connection, waiting: Iterator[tuple[int, Any]]) -> int | None:
    """The number of the next task, which has been sent; None where there are no more."""
    number, task = next(waiting, (None, None))
    if number is not None:
        with contextlib.suppress(OSError):  # a worker that is gone is found by what it doesn't answer
            connection.send(task)
    return number


def _received(connection: Connection, process: SpawnProcess) -> Any:
    try:
        good, result = connection.recv()
    except (EOFError, OSError):
        process.join()
        code = process.exitcode or 0
        if code < 0:
            how = f"was killed by {signal.Signals(-code).name} (where memory is short, use fewer)"
        else:
            how = f"ended with status {code} (a script that starts some does so under if __name__ == '__main__')"
        raise WorkerError(f"a worker process {how}") from None
    if not good:
        raise result
    return result


def _serve(function: Callable[[Any], Any], connection: Connection) -> None:
    """What a worker does: tasks, until nobody sends any. Ctrl-C is for the caller alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError, OSError):
        while True:
            task = connection.recv()
            try:
                answer: tuple[bool, Any] = True, function(task)
            except Exception as error:
                answer = False, error
            connection.send(answer)


@contextlib.contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Processes started meanwhile don't get Ctrl-C before they can ignore it; ours comes afterwards."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
