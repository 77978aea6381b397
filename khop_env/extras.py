"""Optional dependencies: what to type to install one."""

from __future__ import annotations


def how_to_install(extra: str) -> str:
    """The line that installs an extra, for error messages; it works in a clone, with its constraints.

    Args:
        extra: of pyproject.toml, e.g. "rl".
    """
    return f"in a clone of khop_env, pip install -c constraints.txt -e '.[{extra}]'"
