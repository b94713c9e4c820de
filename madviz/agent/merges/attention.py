"""Merging by attention between places: every view asks the others, then the views are summed.

Every view's 49 places (64 numbers each) ask the places of the *other* present views (paper, merge
methods; sizes are published nowhere, so these are the smallest that keep the idea, as in
``vit.py``). The answers are added to the view, and the views are summed as in MAD. With one view
left nobody answers and M = V_i: the same feature a sum would give. 4 heads.

An absent view is never attended to and never counted. All subsets are read from the same
projections.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from madviz.agent.merges.base import Merge, Noise, Streams, each_stream
from madviz.agent.networks import FEATURE_MAP, FEATURE_SIZE, Encoder, NetworkConfig, orthogonal

HEADS = 4
_NEVER = -1e9
"""A score that softmax turns to 0. Minus infinity would give NaN where a view is all alone."""


class CrossAttention(Merge):
    """The shared CNN, and attention from every view to the others."""

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        super().__init__(config, streams)
        self.cnn = Encoder(config.frame_stack)
        width = FEATURE_MAP[0]
        self.norm = nn.LayerNorm(width)
        self.query, self.key, self.value, self.out = (
            nn.Linear(width, width, bias=False) for _ in range(4)
        )
        orthogonal(self)

    def encode(self, views: Tensor) -> Tensor:
        return each_stream(self.cnn, views)

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        """(B, V, Z), (N, V) -> (N, B, Z)."""
        count = features.shape[1]
        places = FEATURE_SIZE // FEATURE_MAP[0]
        tokens = features.unflatten(-1, (FEATURE_MAP[0], places)).transpose(-1, -2)
        # tokens: (B, V, 49, 64)
        seen = self.norm(tokens).flatten(1, 2)  # (B, V * 49, 64)
        query, key, value = (split_heads(part(seen)) for part in (self.query, self.key, self.value))
        masks = masks.bool()
        others = masks[:, None, :] & ~torch.eye(count, dtype=torch.bool, device=masks.device)
        allowed = others.repeat_interleave(places, 1).repeat_interleave(places, 2)
        # allowed: (N, V * 49, V * 49), whether a place may ask another
        answers = torch.stack([attend(query, key, value, one) for one in allowed])
        answers = self.out(answers).unflatten(2, (count, places))  # (N, B, V, 49, 64)
        answered = others.any(-1)[:, None, :, None, None]
        present = masks.to(tokens.dtype)[:, None, :, None, None]
        merged = ((tokens + answers * answered) * present).sum(2)
        return merged.transpose(-1, -2).flatten(2)


def attend(query: Tensor, key: Tensor, value: Tensor, allowed: Tensor) -> Tensor:
    """softmax(q k^T / sqrt(d)) v over the ``allowed`` (T, T) pairs of T tokens, heads side by side.

    (B, heads, T, d) three times -> (B, T, heads * d).
    """
    scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
    shares = torch.softmax(scores.masked_fill(~allowed, _NEVER), -1)
    return (shares.to(value.dtype) @ value).transpose(1, 2).flatten(2)


def split_heads(x: Tensor) -> Tensor:
    """(B, T, heads * d) -> (B, heads, T, d)."""
    return x.unflatten(-1, (HEADS, -1)).transpose(1, 2)
