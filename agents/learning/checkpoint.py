"""Checkpoints of a training run, as arrays and JSON in one .npz file; reading one executes no code from the file."""

from __future__ import annotations

import dataclasses
import json
import random
import warnings
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.learning.archive import read_arrays, write_arrays
from agents.learning.replay import replay_state, restore_replay

FORMAT = 2
_SEED = ("entropy", "spawn_key", "pool_size", "n_children_spawned")  # of a seed sequence, from which keys are spawned
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
_LAST = ("_last_obs", "_last_episode_starts", "_last_original_obs")


class CheckpointError(ValueError):
    """The checkpoint can't be read or doesn't fit; the message says which file and why."""


def write_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Write nested mappings, sequences, dataclasses, generators, arrays, tensors and plain values, uncompressed."""
    arrays: list[np.ndarray] = []
    text = json.dumps({"format": FORMAT, "content": _encoded(content, arrays)})
    named = {str(number): array for number, array in enumerate(arrays)}
    write_arrays(path, {"tree": np.array(text), **named}, compress=False)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint; dataclasses and generators become mappings of their fields, tensors become arrays.

    Raises:
        CheckpointError: if the file wasn't written by `write_checkpoint`.
    """
    try:
        arrays = read_arrays(path, path.stat().st_size)  # uncompressed
        tree = json.loads(str(arrays["tree"]))
        if tree["format"] != FORMAT:
            raise ValueError(f"its format is {tree['format']!r:.40}; expected {FORMAT}")
        content = _decoded(tree["content"], arrays)
        if not isinstance(content, dict):
            raise ValueError("it holds no settings")
        return content
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise CheckpointError(f"{path} isn't a checkpoint that khop train wrote ({error})") from error


def restored(template: Any, stored: Any, where: str) -> Any:
    """Decoded values with the structure of `template`, dataclasses and generators included.

    Raises:
        ValueError: if keys, lengths, types or shapes differ; the message names the place.
    """
    if isinstance(template, np.random.Generator):
        seed = stored["seed"]
        bits = type(template.bit_generator)(np.random.SeedSequence(**{name: seed[name] for name in _SEED}))
        bits.state = stored["state"]
        return np.random.Generator(bits)
    if dataclasses.is_dataclass(template) and not isinstance(template, type):
        fields = {field.name: getattr(template, field.name) for field in dataclasses.fields(template)}
        return type(template)(**restored(fields, stored, where))
    if isinstance(template, Mapping):
        if not isinstance(stored, dict) or list(stored) != list(template):
            raise ValueError(f"{where} must have the entries {list(template)}")
        return {key: restored(value, stored[key], f"{where}.{key}") for key, value in template.items()}
    if isinstance(template, list | tuple):
        if type(stored) is not type(template) or len(stored) != len(template):
            raise ValueError(f"{where} must be a {type(template).__name__} of length {len(template)}")
        return type(template)(
            restored(expected, value, f"{where}[{q}]")
            for q, (expected, value) in enumerate(zip(template, stored, strict=True))
        )
    if type(stored) is not type(template):
        raise ValueError(f"{where} is of type {type(stored).__name__}, not {type(template).__name__}")
    if isinstance(template, np.ndarray) and (stored.shape, stored.dtype) != (template.shape, template.dtype):
        raise ValueError(f"{where} is {stored.dtype} of shape {stored.shape}, not {template.dtype} {template.shape}")
    return stored


def model_state(model: BaseAlgorithm) -> dict[str, Any]:
    """The state of a Stable-Baselines3 model that its next update depends on."""
    _, variables = model._get_torch_save_params()
    return {
        **({"replay": replay_state(model)} if isinstance(model, SAC) else {}),
        "parameters": model.get_parameters(),
        "variables": {name: attrgetter(name)(model) for name in variables},
        "counters": {name: getattr(model, name) for name in _COUNTERS},
        "last": {name: getattr(model, name) for name in _LAST},
        "memory": _memory(model),
        "random": {
            "torch": torch.get_rng_state(),
            "numpy": np.random.get_state(),  # noqa: NPY002  # Stable-Baselines3 shuffles with it
            "python": random.getstate(),
        },
    }


def restore_model(model: BaseAlgorithm, stored: Mapping[str, Any]) -> None:
    """Restore the saved state of a model in a new one with the same settings.

    Warns:
        UserWarning: if it is without its replay buffer, as earlier versions saved it.

    Raises:
        ValueError: if `stored` doesn't fit the model.
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
    if "replay" in stored and isinstance(model, SAC):
        restore_replay(model, stored["replay"])
    elif isinstance(model, SAC):
        warnings.warn(
            "an earlier version wrote this checkpoint, without SAC's replay buffer: the training goes on with an empty "
            "one, and not as if it had never been interrupted",
            stacklevel=2,
        )
    if own := [each.numpy() for each in _memory(model)]:
        memory = [_tensors(each) for each in restored(own, stored["memory"], "memory")]
        _set_memory(model, memory)
    torch.set_rng_state(_tensors(stored["random"]["torch"]))
    np.random.set_state(stored["random"]["numpy"])  # noqa: NPY002
    random.setstate(stored["random"]["python"])


def restore_networks(model: BaseAlgorithm, stored: Mapping[str, Any]) -> None:
    """Restore the networks of a saved model in a new one, but not what its optimizers remember.

    Raises:
        ValueError: if `stored` doesn't fit the model.
    """
    own = _arrays(dict(model.policy.state_dict()))
    model.policy.load_state_dict(_tensors(restored(own, dict(stored["parameters"]["policy"]), "networks")))


def _memory(model: Any) -> list[torch.Tensor]:
    """What a recurrent model remembers of the running episodes: output and cell of the actor, and of the critic."""
    states = getattr(model, "_last_lstm_states", None)
    return [] if states is None else [*states.pi, *states.vf]


def _set_memory(model: Any, memory: Sequence[torch.Tensor]) -> None:
    model._last_lstm_states = type(model._last_lstm_states)(tuple(memory[:2]), tuple(memory[2:]))


def _optimizer_state(optimizer: torch.optim.Optimizer, stored: Any, where: str) -> dict[str, Any]:
    """The stored state after checks, which `load_state_dict` doesn't make."""
    groups = restored(optimizer.state_dict()["param_groups"], stored["param_groups"], f"{where}.param_groups")
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for number, values in stored["state"].items():
        shape = tuple(parameters[number].shape)
        for name, value in values.items():
            if value.shape not in ((), shape) or value.dtype != np.float32:
                raise ValueError(f"{where}: {name} of parameter {number} is {value.dtype} of shape {value.shape}")
    return {"param_groups": groups, "state": _tensors(stored["state"])}


def _encoded(value: Any, arrays: list[np.ndarray]) -> Any:
    """A JSON value; arrays are appended to the list and replaced by their index."""
    if isinstance(value, np.ndarray | np.generic | torch.Tensor):
        arrays.append(value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value))
        return {"number" if isinstance(value, np.generic) else "array": len(arrays) - 1}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.random.Generator):
        bits, seed = value.bit_generator, value.bit_generator.seed_seq
        return _encoded({"state": bits.state, "seed": {name: getattr(seed, name) for name in _SEED}}, arrays)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _encoded({field.name: getattr(value, field.name) for field in dataclasses.fields(value)}, arrays)
    if isinstance(value, Mapping):
        return {"dict": [[key, _encoded(item, arrays)] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_encoded(item, arrays) for item in value]}
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
        return {key: _decoded(item, arrays) for key, item in value}
    return {"list": list, "tuple": tuple}[kind](_decoded(item, arrays) for item in value)


def _arrays(value: Any) -> Any:
    """Convert a tensor, or nested mappings of tensors, to arrays."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy()
    return {key: _arrays(item) for key, item in value.items()}


def _tensors(value: Any) -> Any:
    """Convert an array, or nested mappings of arrays, to tensors with memory of their own."""
    if isinstance(value, Mapping):
        return {key: _tensors(item) for key, item in value.items()}
    return torch.tensor(value)
