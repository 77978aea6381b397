"""Stable-Baselines3 models of a training run, and their export as arrays."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from agents.learning.attention import SlotAttention
from agents.learning.config import TrainingConfig
from agents.learning.forward import Attention, Layers, Mlp, Network, Recurrent
from agents.learning.learned import LearnedPolicy
from agents.learning.scaling import ObservationScaler
from agents.learning.slots import SlotScaler
from agents.learning.state_critic import BesideState, StateCriticPolicy, StateCriticSACPolicy
from khop_env.extras import how_to_install

REPLAY = 400_000  # agent-steps that SAC learns from, the last ones


class PerTypeExtractor(nn.Module):
    """A network for each agent type, selected by the type's one-hot columns in the observation.

    Each type's latent features, with a constant 1, have a block of their own and are zero elsewhere, so that the linear
    heads added by Stable-Baselines3 are separate for each type; only one bias and the standard deviation of the
    exploration are shared.

    Args:
        features: number of features.
        hidden: widths of the hidden layers.
        types: columns of the one-hot.
        state: number of the last features, of the global state, which only critics get.
    """

    def __init__(self, features: int, hidden: Sequence[int], types: Sequence[int], state: int = 0) -> None:
        super().__init__()
        self.types, self._own = list(types), features - state
        self.actors = nn.ModuleList(_mlp(self._own, hidden) for _ in types)
        self.critics = nn.ModuleList(_mlp(features, hidden) for _ in types)
        self.latent_dim_pi = self.latent_dim_vf = len(self.types) * (hidden[-1] + 1)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latent features of actor and critic, each (batch, blocks)."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Latent features of the actor (batch, blocks)."""
        return self._blocks(self.actors, features[:, : self._own])

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Latent features of the critic (batch, blocks)."""
        return self._blocks(self.critics, features)

    def _blocks(self, networks: nn.ModuleList, features: torch.Tensor) -> torch.Tensor:
        constant = torch.ones_like(features[:, :1])
        blocks = [
            features[:, [column]] * torch.cat([network(features), constant], dim=1)
            for column, network in zip(self.types, networks, strict=True)
        ]
        return torch.cat(blocks, dim=1)


class PerTypePolicy(ActorCriticPolicy):
    """PPO's policy with a network for each agent type.

    Args:
        arguments: positional arguments of `ActorCriticPolicy`.
        types: columns of the one-hot.
        hidden: widths of the layers.
        state: number of the last features, of the global state, which only critics get.
        keywords: keyword arguments of `ActorCriticPolicy`.
    """

    def __init__(
        self, *arguments: Any, types: Sequence[int], hidden: Sequence[int], state: int = 0, **keywords: Any
    ) -> None:
        self._types, self._hidden, self._state = list(types), list(hidden), state
        super().__init__(*arguments, **keywords)

    def _build_mlp_extractor(self) -> None:
        networks = PerTypeExtractor(self.features_dim, self._hidden, self._types, self._state)
        self.mlp_extractor = networks  # type: ignore[assignment]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"types": self._types, "hidden": self._hidden, "state": self._state}
        return {**super()._get_constructor_parameters(), **own}


def make_model(config: TrainingConfig, env: VecEnv, types: Sequence[int], log: str | None) -> BaseAlgorithm:
    """PPO or SAC with the run's settings; on top of a script their actions are 0 before training, but for exploration.

    Args:
        config: the settings.
        env: the environment from `training_environment`.
        types: columns of the one-hot of agent types.
        log: folder for TensorBoard, or None for no log.
    """
    model = _model(config, env, types, log)
    if config.residual is not None:
        last: Any = model.policy.actor.mu if isinstance(model, SAC) else model.policy.action_net
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
    return model


def require_installed(config: TrainingConfig) -> None:
    """Refuse to train with what needs a package that isn't installed.

    Raises:
        ModuleNotFoundError: with what to install.
    """
    if config.policy == "recurrent" and importlib.util.find_spec("sb3_contrib") is None:
        raise ModuleNotFoundError(f"recurrent policies are trained with sb3_contrib: {how_to_install('rl')}")
    if config.backend == "jax" and importlib.util.find_spec("jax") is None:
        raise ModuleNotFoundError(f"backend 'jax' needs JAX: {how_to_install('jax')}")


def _model(config: TrainingConfig, env: VecEnv, types: Sequence[int], log: str | None) -> BaseAlgorithm:
    common: dict[str, Any] = {"seed": config.seed, "gamma": config.gamma, "tensorboard_log": log, "device": "cpu"}
    net: dict[str, Any] = {"activation_fn": nn.ReLU, **_extractor(config, env)}
    sees_state = config.critic == "state"
    if config.algorithm == "sac":
        return SAC(
            StateCriticSACPolicy if sees_state else "MlpPolicy",
            env,
            learning_rate=config.learning_rate,
            batch_size=config.batch_size,
            buffer_size=REPLAY,
            train_freq=1,
            gradient_steps=4,
            learning_starts=4 * env.num_envs,
            policy_kwargs={**net, "net_arch": list(config.hidden)},
            **common,
        )
    net["log_std_init"] = config.log_std
    if sees_state:
        net["state"] = net["features_extractor_kwargs"]["state"]
    algorithm: Any = PPO
    policy: Any
    if config.backend == "jax":
        from agents.learning.jax_ppo import JaxPPO

        algorithm = JaxPPO
    if config.policy == "recurrent":
        from agents.learning.recurrent import RecurrentPolicy, RecurrentPPO

        algorithm, policy = RecurrentPPO, RecurrentPolicy
        net["hidden"] = list(config.hidden)
    elif config.per_type:
        policy = PerTypePolicy
        net |= {"types": list(types), "hidden": list(config.hidden)}
    else:
        policy = StateCriticPolicy if sees_state else "MlpPolicy"
        net["net_arch"] = {"pi": list(config.hidden), "vf": list(config.hidden)}
    rate = config.learning_rate
    return algorithm(
        policy,
        env,
        learning_rate=LinearlyTo0(rate),
        n_steps=config.n_steps,
        batch_size=_divisor(config.n_steps * env.num_envs, config.batch_size),
        n_epochs=config.n_epochs,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        ent_coef=config.entropy,
        policy_kwargs=net,
        **common,
    )


def _extractor(config: TrainingConfig, env: VecEnv) -> dict[str, Any]:
    """What a policy of Stable-Baselines3 gets to extract features; actor and critic have extractors of their own."""
    found: dict[str, Any] = {}
    wrapped: Any = env
    if config.policy == "attention":
        scaler: SlotScaler = wrapped.scaler
        found = {
            "features_extractor_class": SlotAttention,
            "features_extractor_kwargs": {"own": len(scaler.own), "slot": len(scaler.slot)},
            "share_features_extractor": False,
        }
    if config.critic == "state":
        inner = found.get("features_extractor_class", FlattenExtractor)
        arguments = {"inner": inner, "arguments": found.get("features_extractor_kwargs", {})}
        found["features_extractor_class"] = BesideState
        found["features_extractor_kwargs"] = {"state": wrapped.state.size, **arguments}
    return found


def _divisor(samples: int, wanted: int) -> int:
    """The batch size near the wanted value that divides the number of samples per update."""
    count = max(1, round(samples / wanted))
    while samples % count:
        count += 1
    return samples // count


class LinearlyTo0:
    """A learning rate that decreases linearly to 0 over the training.

    Args:
        rate: initial learning rate.
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def __call__(self, remaining: float) -> float:
        """The learning rate when the fraction `remaining` of the training is left."""
        return self.rate * max(0.0, remaining)


def actor_networks(model: BaseAlgorithm, types: Sequence[str]) -> dict[str, Network]:
    """The deterministic actor without torch, by agent type ("" for all types).

    Args:
        model: PPO or SAC.
        types: names of the agent types, in the order of the one-hot.
    """
    policy: Any = model.policy
    if hasattr(policy, "lstm_actor"):
        from agents.learning.recurrent import actor_network

        return {"": actor_network(model)}
    if isinstance(model, SAC) or not isinstance(policy.mlp_extractor, PerTypeExtractor):
        extractor, layers = _actor(model)
        if isinstance(extractor, SlotAttention):
            (encoder,), scores = _layers(extractor.encoder), extractor.scores.weight.detach().numpy().copy()
            return {"": Attention(encoder, scores, _layers(layers))}
        return {"": Mlp(_layers(layers))}
    extractor, head = policy.mlp_extractor, policy.action_net
    networks: dict[str, Network] = {}
    weight, bias = (parameter.detach().numpy().copy() for parameter in (head.weight, head.bias))
    width = weight.shape[1] // len(types)
    for number, kind in enumerate(types):
        block = weight[:, number * width : (number + 1) * width]
        head_of_type = block[:, :-1].copy(), bias + block[:, -1]
        networks[kind] = Mlp((*_layers(extractor.actors[number]), head_of_type))
    return networks


def load_actor(model: BaseAlgorithm, networks: Mapping[str, Network]) -> None:
    """Give a model with one network for all agents the actor that `actor_networks` returned, of the same shapes.

    Raises:
        ValueError: for networks by type, of which a file has too little.
    """
    if "" not in networks:
        raise ValueError("a policy's file with a network for each type isn't enough: name the folder of its run")
    network = networks[""]
    if isinstance(network, Recurrent):
        from agents.learning.recurrent import load_actor_network

        load_actor_network(model, network)
        return
    extractor, layers = _actor(model)
    parameters = [*extractor.parameters(), *(each for layer in layers for each in layer.parameters())]
    with torch.no_grad():
        for parameter, array in zip(parameters, network.arrays().values(), strict=True):  # in the same order
            if parameter.shape != array.shape:
                raise ValueError(f"its layers have shapes as {array.shape}, and here {tuple(parameter.shape)}")
            parameter.copy_(torch.as_tensor(array))


def _actor(model: BaseAlgorithm) -> tuple[nn.Module, list[nn.Module]]:
    """The extractor, and the modules from there to the action's mean, of a model with one network for all agents."""
    policy: Any = model.policy
    if isinstance(model, SAC):
        extractor, layers = policy.actor.features_extractor, [*policy.actor.latent_pi, policy.actor.mu]
    else:
        extractor, layers = policy.pi_features_extractor, [*policy.mlp_extractor.policy_net, policy.action_net]
    return extractor.inner if isinstance(extractor, BesideState) else extractor, layers


def exported(
    model: BaseAlgorithm,
    config: TrainingConfig,
    environment: str,
    columns: Sequence[str],
    types: Sequence[str],
    scaler: ObservationScaler | SlotScaler,
    about: dict[str, Any],
) -> LearnedPolicy:
    """The model's actor as a policy that needs neither torch nor Stable-Baselines3.

    Args:
        model: PPO or SAC.
        config: settings of the run.
        environment: name of the environment.
        columns: names of the observation's columns, as `LearnedPolicy` has them.
        types: names of the agent types, in the order of the one-hot.
        scaler: scaler of observations.
        about: settings and versions of the training run.
    """
    shape = model.action_space.shape
    assert shape is not None
    squash, networks = config.algorithm == "sac", actor_networks(model, types)
    return LearnedPolicy(environment, tuple(columns), int(shape[0]), squash, networks, scaler, about)


def _mlp(features: int, hidden: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, width in zip([features, *hidden[:-1]], hidden, strict=True):
        layers += [nn.Linear(before, width), nn.ReLU()]
    return nn.Sequential(*layers)


def _layers(modules: Any) -> Layers:
    return tuple(
        (layer.weight.detach().numpy().astype(np.float32), layer.bias.detach().numpy().astype(np.float32))
        for layer in modules
        if isinstance(layer, nn.Linear)
    )
