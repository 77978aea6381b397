"""Run independent tasks on a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from agents.workers import WorkerError
from khop_env.extras import how_to_install


def run_on_ray(function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    """Yield the index and result of each task in order of completion.

    Ray runs a task that was lost with a machine again, up to three times. An existing cluster is used (Ray reads its
    address from RAY_ADDRESS, then looks on this machine); otherwise Ray starts a local one, which is shut down after
    the last result.

    Args:
        function: called with each task; every call gets a copy of it, and the workers need khop_env installed.
        tasks: arguments of `function`.

    Raises:
        ModuleNotFoundError: if Ray isn't installed.
        WorkerError: if a task is lost for good.
        ValueError: if `function` raises it for a task.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"a Ray cluster needs Ray: {how_to_install('ray')}") from error

    started = not ray.is_initialized()
    if started:
        ray.init(log_to_driver=False, include_dashboard=False, logging_level="warning")
    waiting: dict[Any, int] = {}
    try:
        remote, shared = ray.remote(max_retries=3)(_called), ray.put(function)
        waiting = {remote.remote(shared, task): number for number, task in enumerate(tasks)}
        while waiting:
            ready, _ = ray.wait(list(waiting))
            for reference in ready:
                number = waiting.pop(reference)
                try:
                    result = ray.get(reference)
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None
                except ray.exceptions.RayError as error:
                    lost = WorkerError(f"a task on the cluster was lost: {error}")
                    lost.task = number
                    raise lost from error
                yield number, result
    finally:
        for reference in waiting:  # after an error or Ctrl-C
            ray.cancel(reference, force=True)
        if started:
            ray.shutdown()


def _called(function: Callable[[Any], Any], task: Any) -> Any:
    return function(task)
