"""The folder of a run: its name says what was run, and no run overwrites another one's files."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from khop_env.terminal import say

SUMMARY = "summary.json"
_LONGEST = 60  # characters of one part of a name


def folder_name(*parts: str) -> str:
    """One visible folder for names that may hold anything: "paper-tanh-estimate-seed0"."""
    return "-".join(_part(part) for part in parts if part)


def _part(text: str) -> str:
    found = re.sub(r"[^\w.-]+", "_", text).strip("._-") or "scenario"
    if len(found) > _LONGEST:
        found = f"{found[: _LONGEST - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    return found


def choose_folder(default: Path, out: Path | None, configuration: Mapping[str, Any]) -> Path:
    """The folder of a run, made; one that holds a run of another configuration isn't taken.

    Args:
        default: where the files go unless the user names a folder; "-2", "-3" and so on are added where another run
            is there.
        out: the user's own, or None.
        configuration: what the numbers of the run depend on, as JSON has it; it has to be "configuration" in the
            run's summary.json.

    Raises:
        ValueError: if another run is in the folder that the user names.
        OSError: if it can't be made.
    """
    if out is not None:
        if (differs := _difference(out, configuration)) is not None:
            raise ValueError(f"--out {out}: another run is there ({differs}); choose another folder, or delete it")
        out.mkdir(parents=True, exist_ok=True)
        return out
    candidates = (default.with_name(f"{default.name}-{n}" if n > 1 else default.name) for n in itertools.count(1))
    skipped: list[str] = []
    for folder in candidates:
        differs = _difference(folder, configuration)
        if differs is None:
            break
        skipped.append(f"{folder} holds another run ({differs})")
    folder.mkdir(parents=True, exist_ok=True)
    if skipped:
        say(f"khop: {skipped[-1]}; the files go to {folder}")
    return folder


def digest(*values: Any) -> str:
    """A short name for a scenario, task or policy, that changes with everything that it is made of."""
    from agents.learning.fingerprint import plain

    try:
        text = json.dumps([plain(value) for value in values], sort_keys=True, default=str)
    except RecursionError:  # an object of the user's own that holds itself
        text = repr([type(value) for value in values])
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def sources(values: Iterable[Any]) -> list[str]:
    """Digests of the files that the types of these values are defined in, those of the library left out."""
    modules = {value.__module__ if isinstance(value, type) else type(value).__module__ for value in values}
    own = sorted(name for name in modules if not name.startswith(("khop_env.", "agents.", "builtins")))
    files = [getattr(sys.modules.get(name), "__file__", None) for name in own]
    return [hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12] for file in files if file is not None]


def _difference(folder: Path, configuration: Mapping[str, Any]) -> str | None:
    """How the run in a folder differs from this one; None where it doesn't, or there is none."""
    from agents.learning.fingerprint import differences

    try:
        found = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except NotADirectoryError:
        return None  # making the folder says it
    except (OSError, ValueError):
        return f"its {SUMMARY} can't be read"
    theirs = found.get("configuration") if isinstance(found, dict) else None
    if not isinstance(theirs, dict):
        return "of an earlier version"
    return differences(theirs, json.loads(json.dumps(configuration))) or None
