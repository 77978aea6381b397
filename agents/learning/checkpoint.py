"""Checkpoints of a training run, as arrays and JSON in one .npz file: reading one runs no code of its author's."""

from __future__ import annotations

import dataclasses
import json
import random
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.learning.archive import read_arrays, write_arrays

FORMAT = 1
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
_LAST = ("_last_obs", "_last_episode_starts", "_last_original_obs")


class CheckpointError(ValueError):
    """A checkpoint that can't be read, or doesn't fit; the message says which file and what is wrong."""


def write_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Write nested mappings, sequences, dataclasses, generators, arrays, tensors and plain values; uncompressed."""
    arrays: list[np.ndarray] = []
    text = json.dumps({"format": FORMAT, "content": _encoded(content, arrays)})
    named = {str(number): array for number, array in enumerate(arrays)}
    write_arrays(path, {"tree": np.array(text), **named}, compress=False)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What was written; dataclasses and generators as mappings of their fields, tensors as arrays.

    Raises:
        CheckpointError: for a file that `write_checkpoint` didn't write.
    """
    try:
        arrays = read_arrays(path, path.stat().st_size)  # it isn't compressed
        tree = json.loads(str(arrays["tree"]))
        if tree["format"] != FORMAT:
            raise ValueError(f"its format is {tree['format']!r:.40}, this version reads {FORMAT}")
        content = _decoded(tree["content"], arrays)
        if not isinstance(content, dict):
            raise ValueError("it holds no settings")
        return content
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise CheckpointError(f"{path} isn't a checkpoint that khop train wrote ({error})") from error


def restored(template: Any, stored: Any, where: str) -> Any:
    """Decoded values in the form of `template`, with its dataclasses and generators.

    Raises:
        ValueError: naming the place where the two have different keys, lengths, types or shapes.
    """
    if isinstance(template, np.random.Generator):
        bits = type(template.bit_generator)()
        bits.state = stored
        return np.random.Generator(bits)
    if dataclasses.is_dataclass(template) and not isinstance(template, type):
        fields = {one.name: getattr(template, one.name) for one in dataclasses.fields(template)}
        return type(template)(**restored(fields, stored, where))
    if isinstance(template, Mapping):
        if not isinstance(stored, dict) or list(stored) != list(template):
            raise ValueError(f"{where} has other entries")
        return {key: restored(value, stored[key], f"{where}.{key}") for key, value in template.items()}
    if isinstance(template, list | tuple):
        if type(stored) is not type(template) or len(stored) != len(template):
            raise ValueError(f"{where} is another list")
        return type(template)(
            restored(one, other, f"{where}[{q}]") for q, (one, other) in enumerate(zip(template, stored, strict=True))
        )
    if type(stored) is not type(template):
        raise ValueError(f"{where} is of type {type(stored).__name__}, not {type(template).__name__}")
    if isinstance(template, np.ndarray) and (stored.shape, stored.dtype) != (template.shape, template.dtype):
        raise ValueError(f"{where} is {stored.dtype} of shape {stored.shape}, not {template.dtype} {template.shape}")
    return stored


def model_state(model: BaseAlgorithm) -> dict[str, Any]:
    """All of a Stable-Baselines3 model that its next update depends on, but for a replay buffer."""
    _, variables = model._get_torch_save_params()
    return {
        "parameters": model.get_parameters(),
        "variables": {name: attrgetter(name)(model) for name in variables},
        "counters": {name: getattr(model, name) for name in _COUNTERS},
        "last": {name: getattr(model, name) for name in _LAST},
        "random": {
            "torch": torch.get_rng_state(),
            "numpy": np.random.get_state(),  # noqa: NPY002  # Stable-Baselines3 shuffles with it
            "python": random.getstate(),
        },
    }


def restore_model(model: BaseAlgorithm, stored: Mapping[str, Any]) -> None:
    """Bring a new model of the same settings into the state that was saved.

    Raises:
        ValueError: for what isn't such a state.
    """
    ours = model_state(model)
    for name, own in ours["parameters"].items():
        theirs = stored["parameters"][name]
        if isinstance(module := attrgetter(name)(model), torch.optim.Optimizer):
            theirs = _optimizer_state(module, theirs, name)
        else:
            theirs = _tensors(restored(_arrays(own), dict(theirs), name))
        module.load_state_dict(theirs)
    for name, own in ours["variables"].items():
        own.data.copy_(_tensors(restored(_arrays(own), stored["variables"][name], name)))
    for name, value in restored(ours["counters"], stored["counters"], "counters").items():
        setattr(model, name, value)
    rows = np.zeros((model.n_envs, *(model.observation_space.shape or ())), np.float32)
    for name in _LAST:
        expected = np.zeros(model.n_envs, bool) if name == "_last_episode_starts" else rows
        setattr(model, name, restored(expected, stored["last"][name], name))
    torch.set_rng_state(_tensors(stored["random"]["torch"]))
    np.random.set_state(stored["random"]["numpy"])  # noqa: NPY002
    random.setstate(stored["random"]["python"])


def _optimizer_state(optimizer: torch.optim.Optimizer, stored: Any, where: str) -> dict[str, Any]:
    """What its `load_state_dict`, which checks nothing, may be given."""
    groups = restored(optimizer.state_dict()["param_groups"], stored["param_groups"], f"{where}.param_groups")
    parameters = [one for group in optimizer.param_groups for one in group["params"]]
    for number, values in stored["state"].items():
        shape = tuple(parameters[number].shape)
        for name, value in values.items():
            if value.shape not in ((), shape) or value.dtype != np.float32:
                raise ValueError(f"{where}: {name} of parameter {number} is {value.dtype} of shape {value.shape}")
    return {"param_groups": groups, "state": _tensors(stored["state"])}


def _encoded(value: Any, arrays: list[np.ndarray]) -> Any:
    """A value as JSON has it; arrays go to the list, and their numbers stand for them."""
    if isinstance(value, np.ndarray | np.generic | torch.Tensor):
        arrays.append(value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value))
        return {"number" if isinstance(value, np.generic) else "array": len(arrays) - 1}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.random.Generator):
        return _encoded(value.bit_generator.state, arrays)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _encoded({one.name: getattr(value, one.name) for one in dataclasses.fields(value)}, arrays)
    if isinstance(value, Mapping):
        return {"dict": [[key, _encoded(one, arrays)] for key, one in value.items()]}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_encoded(one, arrays) for one in value]}
    raise TypeError(f"a checkpoint can't hold {type(value).__name__}")


def _decoded(tree: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(tree, dict):
        return tree
    ((kind, value),) = tree.items()
    if kind == "array":
        return arrays[str(value)]
    if kind == "number":
        return arrays[str(value)][()]
    if kind == "dict":
        return {key: _decoded(one, arrays) for key, one in value}
    return {"list": list, "tuple": tuple}[kind](_decoded(one, arrays) for one in value)


def _arrays(value: Any) -> Any:
    """Tensors, nested or not, as arrays."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy()
    return {key: _arrays(one) for key, one in value.items()}


def _tensors(value: Any) -> Any:
    """Arrays, nested or not, as tensors of their own memory."""
    if isinstance(value, Mapping):
        return {key: _tensors(one) for key, one in value.items()}
    return torch.tensor(value)
