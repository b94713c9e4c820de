"""Merging by a transformer: every view is one token, and M is the mean of the present tokens.

A token is 128 numbers with a learned mark for its view's place in the setting; one transformer
layer (4 heads, MLP of 256) lets the tokens attend to each other. 128 is the width of MV-MWM's own
ViT. An absent view is never attended to and never counted.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.merges.attention import attend, split_heads
from madviz.agent.merges.base import Heads, Merge, Noise, Streams, each_stream, wide_heads
from madviz.agent.networks import FEATURE_SIZE, Encoder, NetworkConfig, orthogonal

TOKEN = 128
"""Numbers in a view's token."""


class ViewTransformer(Merge):
    """The shared CNN, and one transformer layer over one token per view."""

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        super().__init__(config, streams)
        self.cnn = Encoder(config.frame_stack)
        self.project = nn.Linear(FEATURE_SIZE, TOKEN)
        self.place = nn.Parameter(0.02 * torch.randn(len(streams), TOKEN))
        self.norm1 = nn.LayerNorm(TOKEN)
        self.norm2 = nn.LayerNorm(TOKEN)
        self.query, self.key, self.value, self.out = (nn.Linear(TOKEN, TOKEN) for _ in range(4))
        self.widen = nn.Linear(TOKEN, 2 * TOKEN)
        self.narrow = nn.Linear(2 * TOKEN, TOKEN)
        orthogonal(self)

    def heads(self, config: NetworkConfig) -> Heads:
        return wide_heads(config, TOKEN)

    def encode(self, views: Tensor) -> Tensor:
        return each_stream(self.cnn, views)

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        """(B, V, Z), (N, V) -> (N, B, 128)."""
        tokens = self.project(features) + self.place  # (B, V, 128)
        seen = self.norm1(tokens)
        query, key, value = (split_heads(part(seen)) for part in (self.query, self.key, self.value))
        masks = masks.bool()
        allowed = masks[:, None, :].expand(-1, masks.shape[1], -1)
        answers = torch.stack([attend(query, key, value, one) for one in allowed])
        x = tokens + self.out(answers)  # (N, B, V, 128)
        x = x + self.narrow(F.gelu(self.widen(self.norm2(x))))
        present = masks.to(x.dtype)[:, None, :, None]
        return (x * present).sum(2) / present.sum(2).clamp(min=1)
