"""Policy files: written by `khop train`; files from untrusted sources are checked completely on reading."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from agents.learning.archive import ArchiveError, read_arrays, write_arrays
from agents.learning.config import ALGORITHMS
from agents.learning.forward import NETWORKS, Attention, Network, numbers, require
from agents.learning.scaling import ObservationScaler
from agents.learning.slots import SlotScaler

FORMAT = 1
MOST_BYTES = 2**28  # limit on a policy's arrays; the shipped policies have less than a thousandth of it
_INDICES = ("valid", "moving", "headed", "heading", "planar", "slots", "places")
_TABLES = ("planar", "slots", "places")  # of two dimensions
_ABOUT = {"algorithm": str, "environment": str, "scenario": str, "bounds": bool}


class PolicyFileError(ValueError):
    """The policy can't be read or doesn't fit the environment; the message says which file and why."""


def write_policy(path: Path, fields: Mapping[str, Any]) -> None:
    """Write a policy into one .npz file.

    Args:
        path: the file.
        fields: fields of `LearnedPolicy`, by name.
    """
    networks: Mapping[str, Network] = fields["networks"]
    meta = {
        "format": FORMAT,
        "environment": fields["environment"],
        "columns": list(fields["columns"]),
        "action_size": fields["action_size"],
        "squash": fields["squash"],
        "types": list(networks),
        "network": next(iter(networks.values())).kind,
        "layers": {kind: len(network.layers) for kind, network in networks.items()},
        "about": dict(fields["about"]),
    }
    scaler: ObservationScaler | SlotScaler = fields["scaler"]
    one = scaler.one if isinstance(scaler, SlotScaler) else scaler
    arrays: dict[str, Any] = {name: getattr(one, name) for name in ("scale", "rate", *_INDICES)}
    for kind, network in networks.items():
        arrays |= {f"{kind}/{name}": array for name, array in network.arrays().items()}
    write_arrays(path, {"meta": np.array(json.dumps(meta)), **arrays}, compress=True)


def read_policy(path: Path) -> dict[str, Any]:
    """Read and check the fields of `LearnedPolicy`.

    Raises:
        PolicyFileError: if the file wasn't written by `write_policy`.
    """
    try:
        return _fields(read_arrays(path, MOST_BYTES))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        if _is_sb3(path):
            raise PolicyFileError(
                f"{path} is a model of Stable-Baselines3: in a file my_sb3.py write policy = "
                f"agents.sb3_policy(PPO.load({str(path)!r})), and name my_sb3.py:policy"
            ) from error
        why = f"it has no {error}" if isinstance(error, KeyError) else error
        raise PolicyFileError(f"{path} isn't a policy that khop train wrote ({why})") from error


def _is_sb3(path: Path) -> bool:
    """Whether `model.save(path)` of Stable-Baselines3 wrote a file; nothing of it is unpacked."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "policy.pth" in archive.namelist()
    except Exception:  # zipfile raises various exceptions for damaged files
        return False


def _fields(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    stored = arrays["meta"]
    require(stored.shape == () and stored.dtype.kind == "U", "meta isn't a string")
    meta = json.loads(str(stored))
    require(isinstance(meta, dict), "meta isn't a JSON object")
    if meta["format"] != FORMAT:
        raise ArchiveError(f"its format is {meta['format']!r:.40}; expected {FORMAT}")
    for name, kind in {"environment": str, "columns": list, "action_size": int, "squash": bool}.items():
        require(type(meta[name]) is kind, f"{name} isn't of type {kind.__name__}")
    columns, about, counts = meta["columns"], meta["about"], meta["layers"]
    require(bool(columns) and all(isinstance(name, str) for name in columns), "columns isn't a list of names")
    require(meta["action_size"] > 0, "action_size isn't positive")
    for name, kind in _ABOUT.items():
        require(isinstance(about, dict) and type(about.get(name)) is kind, f"about has no {name}")
    require(about["algorithm"] in ALGORITHMS, f"the algorithm is {about['algorithm']!r:.40}")
    require(isinstance(counts, dict) and bool(counts), "it has no networks")
    require(all(type(count) is int and 0 < count <= 100 for count in counts.values()), "numbers of layers are invalid")
    one = _scaler(arrays, len(columns))
    network = meta.get("network", "mlp")  # in files of earlier versions
    require(isinstance(network, str) and network in NETWORKS, f"its network is {network!r:.40}")
    read, outputs = NETWORKS[network].read, meta["action_size"]
    networks = {kind: read(arrays, kind, count, one.size, outputs) for kind, count in counts.items()}
    scaler: ObservationScaler | SlotScaler = one
    if network == "attention":
        scaler = SlotScaler(one)
        own = [len(scaler.own), *(each.own for each in networks.values() if isinstance(each, Attention))]
        require("slot0.valid" in columns[1:] and columns.index("slot0.valid") == one.valid.min(), "slots are misplaced")
        require(len(set(own)) == 1, f"it has {own} own features")
    return {
        "environment": meta["environment"],
        "columns": tuple(columns),
        "action_size": meta["action_size"],
        "squash": meta["squash"],
        "networks": networks,
        "scaler": scaler,
        "about": about,
    }


def _scaler(arrays: Mapping[str, np.ndarray], columns: int) -> ObservationScaler:
    """The scaler, with its index arrays checked against the number of columns."""
    scale, rate = numbers(arrays, "scale", (columns,)), arrays["rate"]
    require(rate.shape == () and rate.dtype.kind in "fi" and 0.0 < float(rate) < math.inf, "rate isn't positive")
    moving = len(arrays["moving"]) if arrays["moving"].ndim else 0
    limits = {"valid": columns + 1, "planar": columns + moving}
    found = {}
    for name in _INDICES:
        missing = np.zeros((0, 0), np.int64) if name in ("slots", "places") else None  # in files of earlier versions
        index, limit = arrays[name] if missing is None else arrays.get(name, missing), limits.get(name, columns)
        require(index.dtype == np.int64 and index.ndim == 1 + (name in _TABLES), f"{name} isn't an index")
        require(bool(np.all((index >= 0) & (index < limit))), f"{name} is out of range")
        found[name] = index
    headed, planar = len(found["headed"]), found["planar"]
    require(len(found["valid"]) == columns, "valid has the wrong length")
    require(len(found["heading"]) == (2 if headed else 0), "heading isn't a pair of columns")
    require(planar.shape[1] == 2 and (headed > 0 or not len(planar)), "planar doesn't hold pairs")
    require(len(found["slots"]) == len(found["places"]), "slots and places have different lengths")
    require(found["places"].shape[1] > 0 or not len(found["places"]), "places has no columns")
    return ObservationScaler(scale=scale, rate=float(rate), **found)
