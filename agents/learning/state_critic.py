"""Actors that see the first features only, beside critics that see all: the last ones are of the global state.

This is the centralised critic of MAPPO (Yu et al. 2022, "The Surprising Effectiveness of PPO in Cooperative
Multi-Agent Games"), with what they call the agent-specific global state: an agent's own features and the true state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from gymnasium.spaces import Box, Space
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, MlpExtractor
from stable_baselines3.sac.policies import Actor, SACPolicy


class StateExtractor(MlpExtractor):
    """Networks of actor and critic, of which only the critic gets the last features.

    Args:
        features: number of features.
        state: number of the last ones, of the global state.
        keywords: keyword arguments of `MlpExtractor`.
    """

    def __init__(self, features: int, state: int, **keywords: Any) -> None:
        super().__init__(features, **keywords)
        self.policy_net = MlpExtractor(features - state, **keywords).policy_net
        self._own = features - state

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Latent features of the actor, from an agent's own features (batch, own)."""
        latent: torch.Tensor = self.policy_net(features[:, : self._own])
        return latent


class StateCriticPolicy(ActorCriticPolicy):
    """PPO's policy with a critic that sees the global state.

    Args:
        arguments: positional arguments of `ActorCriticPolicy`.
        state: number of the last features, of the global state.
        keywords: keyword arguments of `ActorCriticPolicy`.
    """

    def __init__(self, *arguments: Any, state: int, **keywords: Any) -> None:
        self._state = state
        super().__init__(*arguments, **keywords)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = StateExtractor(
            self.features_dim,
            self._state,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            device=self.device,
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "state": self._state}


class BesideState(BaseFeaturesExtractor):
    """Features of an agent's own columns by another extractor, and the columns of the global state as they are.

    Args:
        space: of all columns.
        state: number of the last ones, of the global state.
        inner: makes the extractor of the others.
        arguments: keyword arguments for `inner`.
        kept: whether features end with the state, as a critic's do.
    """

    def __init__(
        self,
        space: Space[Any],
        state: int,
        inner: type[BaseFeaturesExtractor] = FlattenExtractor,
        arguments: Mapping[str, Any] | None = None,
        kept: bool = True,
    ) -> None:
        assert isinstance(space, Box)
        own = Box(space.low[:-state], space.high[:-state])
        extractor = inner(own, **arguments or {})
        super().__init__(space, extractor.features_dim + state * kept)
        self.inner, self._own, self._kept = extractor, own.shape[0], kept

    def forward(self, columns: torch.Tensor) -> torch.Tensor:
        """Features (batch, features)."""
        features: torch.Tensor = self.inner(columns[:, : self._own])
        return torch.cat([features, columns[:, self._own :]], dim=1) if self._kept else features


class StateCriticSACPolicy(SACPolicy):
    """SAC's policy with critics that see the global state; its features extractor has to be `BesideState`."""

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """The actor, which gets an agent's own features only."""
        arguments = {**self.features_extractor_kwargs, "kept": False}
        return super().make_actor(self.features_extractor_class(self.observation_space, **arguments))
