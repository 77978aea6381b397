"""A training that begins with the networks of another one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from agents.learning.checkpoint import read_checkpoint, restore_networks
from agents.learning.learned import LearnedPolicy
from agents.learning.networks import load_actor
from agents.learning.policy_file import PolicyFileError
from agents.learning.run_folder import CHECKPOINT
from agents.learning.scaling import RATE
from agents.policy import EnvDescription


def begin_from(source: str, model: BaseAlgorithm, new: LearnedPolicy, env: EnvDescription) -> None:
    """Give a new model the networks of another run.

    Args:
        source: a run's folder, from whose end policy, value function and exploration are taken; or a policy's file,
            which has nothing but the policy.
        model: changed.
        new: the model's policy, for comparison.
        env: what it is trained in.

    Raises:
        ValueError: if there is no such run or file, or its observations, actions or networks are others.
    """
    folder = Path(source)
    whole = folder.is_dir()
    try:
        policy = LearnedPolicy.load(folder / "last.npz" if whole else folder)
        period = RATE / policy.scaler.rate  # may be another one: features are in m and m/s
        policy.reset(dataclasses.replace(env, shielded=True, control_period=period), [0])
        if differs := _difference(policy, new):
            raise PolicyFileError(differs)
        if whole and policy.about.get("critic", "local") != new.about["critic"]:
            raise PolicyFileError(
                f"its critic is {policy.about.get('critic', 'local')!r}, and this run's is {new.about['critic']!r}: "
                f"name {folder / 'last.npz'}, of which the policy alone is taken"
            )
        if not whole:
            load_actor(model, policy.networks)
            return
        stored = read_checkpoint(folder / CHECKPOINT)["model"]
        try:
            restore_networks(model, stored)
        except ValueError as error:  # a critic that sees the state of a fleet of another size
            hint = f"name {folder / 'last.npz'}, of which the policy alone is taken"
            raise PolicyFileError(f"its networks are of other sizes ({error}): {hint}") from error
    except (ValueError, KeyError, TypeError, OSError, RuntimeError) as error:
        raise ValueError(f"can't begin from {source}: {error}") from error


def _difference(old: LearnedPolicy, new: LearnedPolicy) -> str:
    """In what networks or features differ; empty if they don't."""
    for name in ("algorithm", "policy", "per_type", "rates", "nearest", "hidden", "residual"):
        pair = [policy.about.get(name, "mlp" if name == "policy" else None) or False for policy in (old, new)]
        if pair[0] != pair[1]:
            return f"it was trained with {name} = {pair[0]!r}, and this run has {name} = {pair[1]!r}"
    if len({network.kind for policy in (old, new) for network in policy.networks.values()}) > 1:
        return "it holds networks of another kind than it says"
    kinds = [" and ".join(sorted(policy.networks)) for policy in (old, new)]
    return "" if kinds[0] == kinds[1] else f"its networks are for agents of type {kinds[0]}, and here for {kinds[1]}"
