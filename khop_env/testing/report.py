"""Results of checks, and their table."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Literal

_WIDTH = 80  # columns of the table

Status = Literal["passed", "failed", "skipped"]


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: name of the check, from `CHECKS`.
        claim: the checked property, in one line.
        status: "passed", "failed" or "skipped".
        detail: if failed, what was got, where, and what was expected; if skipped, the reason; if passed, warnings of
            libraries or omitted comparisons, usually empty.
    """

    name: str
    claim: str
    status: Status
    detail: str = ""


@dataclass(frozen=True)
class Report:
    """Results of all checks of an environment; `str` gives a table of 80 columns, failures last.

    Attributes:
        environment: name of the environment.
        checks: in the order in which they ran.
    """

    environment: str
    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """True if no check failed; some may have been skipped."""
        return all(check.status != "failed" for check in self.checks)

    def __getitem__(self, name: str) -> Check:
        return next(check for check in self.checks if check.name == name)

    def __str__(self) -> str:
        statuses = [check.status for check in self.checks]
        counts = ", ".join(f"{statuses.count(status)} {status}" for status in ("passed", "failed", "skipped"))
        names = max((len(check.name) for check in self.checks), default=0)
        lines = textwrap.wrap(f"{self.environment}: {counts}", _WIDTH)
        for check in sorted(self.checks, key=lambda check: check.status == "failed"):  # where they are seen
            status = check.status.upper() if check.status == "failed" else check.status
            head = f"{status:<8} {check.name:<{names}}  "
            for start, text in ((head, check.claim), (" " * (len(head) + 2), check.detail)):
                lines += textwrap.wrap(text, _WIDTH, initial_indent=start, subsequent_indent=" " * len(start))
        return "\n".join(lines)

    def raise_if_failed(self) -> None:
        """Raise an error if a check failed; for tests.

        Raises:
            AssertionError: if a check failed; the message lists the failed checks.
        """
        failed = tuple(check for check in self.checks if check.status == "failed")
        if failed:
            raise AssertionError(f"\n{Report(self.environment, failed)}")
