"""Ctrl-C during a training: it ends after the current step, so that what was learned can be saved."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from agents.policy import EnvDescription, Observations, Policy
from khop_env.env.layout import Float32Array


class StopError(Exception):
    """Ctrl-C during an update or an evaluation."""


class Interrupts:
    """Remembers that a training has to end.

    Attributes:
        interrupted: whether Ctrl-C was pressed.
    """

    def __init__(self) -> None:
        self.interrupted = False

    @contextmanager
    def caught(self) -> Iterator[None]:
        """Let Ctrl-C end the training after the current step of an episode, an update or an evaluation.

        A second Ctrl-C raises KeyboardInterrupt as usual.
        """
        with contextlib.suppress(StopError):
            if threading.current_thread() is not threading.main_thread():
                yield
                return

            def interrupt(*_: object) -> None:
                self.interrupted = True
                signal.signal(signal.SIGINT, before)

            before = signal.signal(signal.SIGINT, interrupt)
            try:
                yield
            finally:
                signal.signal(signal.SIGINT, before)

    def check(self, *_: object) -> None:
        """End what is running if Ctrl-C was pressed.

        Raises:
            StopError: then.
        """
        if self.interrupted:
            raise StopError

    def stoppable(self, policy: Policy) -> Policy:
        """The same policy, which can be interrupted between its actions."""
        return _Stoppable(policy, self)


class _Stoppable:
    def __init__(self, policy: Policy, interrupts: Interrupts) -> None:
        self._policy, self._interrupts = policy, interrupts

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        self._policy.reset(env, seeds)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        self._interrupts.check()
        return self._policy.act(observations)
