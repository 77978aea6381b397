"""A features extractor for Stable-Baselines3 that treats all slots of an observation alike."""

from __future__ import annotations

import gymnasium as gym
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from agents.learning.slots import slot_widths
from khop_env.env import ObservationLayout

INVALID = -1e9  # instead of a score: its exponential is 0


class SlotAttention(BaseFeaturesExtractor):
    """Attention over the slots of uniform observations: neither their order nor their number matters.

    One layer encodes each slot beside the agent's own columns. Each head then has a share of the encoding, which it
    averages over the valid slots, with a softmax of scores that are linear in the encoding as weights: additive
    attention (Bahdanau et al. 2015, https://arxiv.org/abs/1409.0473), where the own columns are the query. Without
    valid slots the averages are 0. Features are the own columns and the averages.

        policy_kwargs = {
            "features_extractor_class": SlotAttention,
            "features_extractor_kwargs": SlotAttention.widths(env.batched.layouts[0]),
            "share_features_extractor": False,
        }

    Args:
        space: of observations, which begin with the own columns.
        own: number of own columns.
        slot: number of columns of each slot, of which the first is its validity.
        width: of the encoding.
        heads: a divisor of `width`.

    Raises:
        ValueError: if the observations aren't own columns and whole slots, or `heads` is no divisor.
    """

    def __init__(self, space: gym.Space, own: int, slot: int, width: int = 64, heads: int = 4) -> None:
        super().__init__(space, own + width)
        columns = space.shape[-1] if space.shape else 0
        if columns <= own or (columns - own) % slot:
            raise ValueError(f"observations have {columns} columns, which aren't {own} and slots of {slot} columns")
        if width % heads:
            raise ValueError(f"width must be a multiple of heads; got {width} and {heads}")
        self.own, self.slot, self.heads = own, slot, heads
        self.encoder = nn.Sequential(nn.Linear(slot + own, width), nn.ReLU())
        self.scores = nn.Linear(width, heads, bias=False)

    @staticmethod
    def widths(layout: ObservationLayout) -> dict[str, int]:
        """The arguments `own` and `slot` for an environment whose agents have this layout.

        Raises:
            ValueError: if there are no slots, or not all have equally many columns.
        """
        return dict(zip(("own", "slot"), slot_widths(layout), strict=True))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Features (rows, own + width)."""
        own, slots = observations[:, : self.own], observations[:, self.own :].unflatten(1, (-1, self.slot))
        valid = slots[:, :, :1] > 0.5
        slots = slots.masked_fill(~valid, 0.0)
        encoded = self.encoder(torch.cat([slots, own[:, None].expand(-1, slots.shape[1], -1)], dim=2))
        weights = torch.softmax(self.scores(encoded).masked_fill(~valid, INVALID), dim=1) * valid
        shares = encoded.unflatten(2, (self.heads, -1)) * weights[..., None]
        return torch.cat([own, shares.sum(dim=1).flatten(1)], dim=1)
