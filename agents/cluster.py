"""The same work as tasks on a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from khop_env.extras import how_to_install


def run_on_ray(function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    """Number and result of each task, as they come; tasks lost with a machine are run again by Ray, three times.

    A cluster that is running is used (Ray looks for its address in RAY_ADDRESS, then on this machine); otherwise Ray
    starts one on this machine, which ends with the last result.

    Args:
        function: what to run; each task gets a copy of it, and the workers need khop_env installed.
        tasks: its arguments.

    Raises:
        ModuleNotFoundError: without Ray.
        ValueError: what `function` raises for a task.
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
                try:
                    yield waiting.pop(reference), ray.get(reference)
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None
    finally:
        for reference in waiting:  # after an error or Ctrl-C
            ray.cancel(reference, force=True)
        if started:
            ray.shutdown()


def _called(function: Callable[[Any], Any], task: Any) -> Any:
    return function(task)
