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
        name: of the check, one of `CHECKS`.
        claim: what it checks, in a line.
        status: "passed", "failed" or "skipped".
        detail: of a failed one what was got, where, and what was expected; of a skipped one the reason; of a passed one
            what a library warned of or what couldn't be compared, mostly nothing.
    """

    name: str
    claim: str
    status: Status
    detail: str = ""


@dataclass(frozen=True)
class Report:
    """The results of all checks of an environment; as text a table of 80 columns.

    Attributes:
        environment: what was checked.
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
        counts = ", ".join(f"{statuses.count(one)} {one}" for one in ("passed", "failed", "skipped"))
        names = max((len(check.name) for check in self.checks), default=0)
        lines = textwrap.wrap(f"{self.environment}: {counts}", _WIDTH)
        for check in self.checks:
            status = check.status.upper() if check.status == "failed" else check.status
            head = f"{status:<8} {check.name:<{names}}  "
            for start, text in ((head, check.claim), (" " * (len(head) + 2), check.detail)):
                lines += textwrap.wrap(text, _WIDTH, initial_indent=start, subsequent_indent=" " * len(start))
        return "\n".join(lines)

    def raise_if_failed(self) -> None:
        """For tests: a failed check is an error.

        Raises:
            AssertionError: naming what failed, and where.
        """
        failed = tuple(check for check in self.checks if check.status == "failed")
        if failed:
            raise AssertionError(f"\n{Report(self.environment, failed)}")
