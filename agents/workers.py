"""Run independent tasks in several local processes, which end with the caller in any case."""

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
    """A worker ended before its task was finished.

    Attributes:
        task: the task's index; None if no task had been sent.
    """

    task: int | None = None


class Interrupted(KeyboardInterrupt):
    """A KeyboardInterrupt (Ctrl-C) with the results until then.

    Attributes:
        partial: the results until then, of the same type as the function's return value.
    """

    def __init__(self, partial: Any) -> None:
        super().__init__()
        self.partial = partial


class UnfinishedError(RuntimeError):
    """An error after some results were obtained; the message describes it, and `__cause__` is the exception itself.

    Attributes:
        partial: the results until then, of the same type as the function's return value.
    """

    def __init__(self, message: str, partial: Any) -> None:
        super().__init__(message)
        self.partial = partial


def run_in_processes(function: Callable[[Any], Any], tasks: Sequence[Any], workers: int) -> Iterator[tuple[int, Any]]:
    """Yield the index and result of each task in order of completion.

    Closing the generator, also by an exception, kills the workers in the middle of their tasks.

    Args:
        function: called with each task; it is copied to each worker once.
        tasks: arguments of `function`.
        workers: number of processes.

    Raises:
        WorkerError: if a worker is killed or can't start.
        ValueError: if `function` can't be pickled.
        Exception: if `function` raises it for a task.
    """
    waiting, pool = iter(enumerate(tasks)), dict[Connection, SpawnProcess]()
    try:
        pickled = bytes(ForkingPickler.dumps((_serve, function)))
    except Exception as error:  # pickle raises various exceptions
        raise ValueError(f"can't be sent to other processes; use workers=1 ({error})") from error
    try:
        with _sigint_blocked():
            for _ in range(min(workers, len(tasks))):
                connection, process = _started(pickled)
                pool[connection] = process
        running = {connection: _assign(connection, waiting) for connection in pool}
        while busy := [connection for connection, number in running.items() if number is not None]:
            for connection in set(busy).intersection(wait(busy)):
                number = running[connection]
                try:
                    result = _received(connection, pool[connection])
                except WorkerError as error:
                    error.task = number
                    raise
                running[connection] = _assign(connection, waiting)
                assert number is not None
                yield number, result
    finally:
        for process in pool.values():
            process.kill()  # they have nothing to clean up
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
    """Send the next task and return its index; None if there are no more."""
    number, task = next(waiting, (None, None))
    if number is not None:
        with contextlib.suppress(OSError):  # a dead worker is detected when its result is received
            connection.send(task)
    return number


def _received(connection: Connection, process: SpawnProcess) -> Any:
    try:
        good, result = connection.recv()
    except (EOFError, OSError):
        process.join()
        code = process.exitcode or 0
        if code < 0:
            how = f"was killed by {signal.Signals(-code).name} (use fewer workers if memory is short)"
        else:
            how = f"ended with status {code} (a script must start workers under if __name__ == '__main__')"
        raise WorkerError(f"a worker process {how}") from None
    if not good:
        raise result
    return result


def _serve(function: Callable[[Any], Any], connection: Connection) -> None:
    """Main loop of a worker: run tasks until the connection closes. Only the caller handles Ctrl-C."""
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
    """Block Ctrl-C in processes started meanwhile until they ignore it; this process receives it afterwards."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
