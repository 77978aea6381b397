"""Recurrent policies in training: sb3-contrib's RecurrentPPO, and the arrays of its networks."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import Space
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from agents.learning.forward import Recurrent

__all__ = ["RecurrentPPO", "RecurrentPolicy", "actor_network", "load_actor_network"]


class Layers(BaseFeaturesExtractor):
    """Layers before an LSTM, with ReLU after each.

    Args:
        space: of features.
        widths: of the layers; none is possible.
    """

    def __init__(self, space: Space[Any], widths: Sequence[int]) -> None:
        inputs = int(np.prod(space.shape or ()))
        super().__init__(space, [inputs, *widths][-1])
        pairs = zip([inputs, *widths], widths, strict=False)
        self.layers = nn.Sequential(*(layer for pair in pairs for layer in (nn.Linear(*pair), nn.ReLU())))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """(batch, last width)."""
        values: torch.Tensor = self.layers(features)
        return values


class RecurrentPolicy(RecurrentActorCriticPolicy):
    """Actor and critic are layers, an LSTM, and a linear layer each.

    Args:
        observations: space of features.
        actions: space of actions.
        rate: schedule of the learning rate.
        hidden: widths of the layers; the last one is that of the LSTM.
        keywords: keyword arguments of `RecurrentActorCriticPolicy`.
    """

    def __init__(
        self, observations: Space[Any], actions: Space[Any], rate: Any, *, hidden: Sequence[int], **keywords: Any
    ) -> None:
        self._hidden = list(hidden)
        super().__init__(
            observations,
            actions,
            rate,
            net_arch=[],
            lstm_hidden_size=self._hidden[-1],
            features_extractor_class=Layers,
            features_extractor_kwargs={"widths": self._hidden[:-1]},
            share_features_extractor=False,
            **keywords,
        )

    @staticmethod
    def _process_sequence(
        features: torch.Tensor,
        lstm_states: tuple[torch.Tensor, torch.Tensor],
        episode_starts: torch.Tensor,
        lstm: nn.LSTM,
    ) -> tuple[torch.Tensor, Any]:
        """As the original, which runs step by step where an episode begins; this one from one beginning to the next."""
        count = lstm_states[0].shape[1]
        steps = features.reshape(count, -1, lstm.input_size).swapaxes(0, 1)
        starts = episode_starts.reshape(count, -1).swapaxes(0, 1)  # (steps, sequences)
        cuts = [0, *(torch.nonzero(starts[1:].any(dim=1)).flatten() + 1).tolist(), len(steps)]
        outputs = []
        for first, end in itertools.pairwise(cuts):
            kept = (1.0 - starts[first]).view(1, count, 1)
            part, lstm_states = lstm(steps[first:end], (kept * lstm_states[0], kept * lstm_states[1]))
            outputs.append(part)
        return torch.cat(outputs).transpose(0, 1).flatten(end_dim=1), lstm_states


def actor_network(model: BaseAlgorithm) -> Recurrent:
    """The deterministic actor without torch."""
    policy: Any = model.policy
    lstm = policy.lstm_actor
    bias = lstm.bias_ih_l0 + lstm.bias_hh_l0
    layers = [*_linear(model), policy.action_net]
    return Recurrent(
        tuple((_array(layer.weight), _array(layer.bias)) for layer in layers),
        (_array(lstm.weight_ih_l0), _array(lstm.weight_hh_l0), _array(bias)),
    )


def load_actor_network(model: BaseAlgorithm, network: Recurrent) -> None:
    """Give a model the actor that `actor_network` returned, of the same shapes."""
    policy: Any = model.policy
    lstm = policy.lstm_actor
    with torch.no_grad():
        for layer, (weight, bias) in zip([*_linear(model), policy.action_net], network.layers, strict=True):
            layer.weight.copy_(torch.as_tensor(weight))
            layer.bias.copy_(torch.as_tensor(bias))
        names = "weight_ih_l0", "weight_hh_l0", "bias_ih_l0"
        for name, array in zip(names, network.lstm, strict=True):
            getattr(lstm, name).copy_(torch.as_tensor(array))
        lstm.bias_hh_l0.zero_()


def _linear(model: BaseAlgorithm) -> list[nn.Linear]:
    policy: Any = model.policy
    return [layer for layer in policy.pi_features_extractor.layers if isinstance(layer, nn.Linear)]


def _array(tensor: torch.Tensor) -> Any:
    return tensor.detach().numpy().astype(np.float32)
