"""Merging by attention: features of several views look at each other before they become one.

Two of the paper's merge methods (paper, merge methods; sizes are published nowhere, so these are
the smallest that keep each method's idea):

    attention   every view's 49 places (64 numbers each) ask the places of the *other* present
                views; the answers are added to it, and the views are summed as in MAD. With one
                view left nobody answers and M = V_i: the same feature a sum would give. 4 heads.
    vit         every view is one token of 128 numbers with a learned mark for its place in the
                setting; one transformer layer (4 heads, MLP of 256) lets the tokens attend to each
                other; M is the mean of the present tokens. 128 is the width of MV-MWM's own ViT.

An absent view is never looked at and never counted. All subsets are read from the same projections.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.networks import FEATURE_MAP, FEATURE_SIZE, Encoder, orthogonal

HEADS = 4
TOKEN = 128
"""Numbers in a view's token."""
_NEVER = -1e9
"""A score that softmax turns to 0. Minus infinity would give NaN where a view is all alone."""


class CrossAttention(nn.Module):
    """The shared CNN, and attention from every view to the others."""

    def __init__(self, frame_stack: int) -> None:
        super().__init__()
        self.cnn = Encoder(frame_stack)
        width = FEATURE_MAP[0]
        self.norm = nn.LayerNorm(width)
        self.query, self.key, self.value, self.out = (
            nn.Linear(width, width, bias=False) for _ in range(4)
        )
        orthogonal(self)

    def rows(self, features: Tensor, masks: Tensor) -> Tensor:
        """(B, V, Z), (N, V) bool -> (N, B, Z)."""
        count, places = features.shape[1], FEATURE_SIZE // FEATURE_MAP[0]
        tokens = features.unflatten(-1, (FEATURE_MAP[0], places)).transpose(-1, -2)
        seen = self.norm(tokens).flatten(1, 2)  # (B, V * 49, 64)
        query, key, value = (_heads(part(seen)) for part in (self.query, self.key, self.value))
        masks = masks.bool()
        others = masks[:, None, :] & ~torch.eye(count, dtype=torch.bool, device=masks.device)
        allowed = others.repeat_interleave(places, 1).repeat_interleave(places, 2)
        answers = torch.stack([attend(query, key, value, one) for one in allowed])
        answers = self.out(answers).unflatten(2, (count, places))  # (N, B, V, 49, 64)
        answered = others.any(-1)[:, None, :, None, None]
        present = masks.to(tokens.dtype)[:, None, :, None, None]
        merged = ((tokens + answers * answered) * present).sum(2)
        return merged.transpose(-1, -2).flatten(2)


class ViewTransformer(nn.Module):
    """The shared CNN, and one transformer layer over one token per view."""

    def __init__(self, frame_stack: int, views: int) -> None:
        super().__init__()
        self.cnn = Encoder(frame_stack)
        self.project = nn.Linear(FEATURE_SIZE, TOKEN)
        self.place = nn.Parameter(0.02 * torch.randn(views, TOKEN))
        self.norm1, self.norm2 = nn.LayerNorm(TOKEN), nn.LayerNorm(TOKEN)
        self.query, self.key, self.value, self.out = (nn.Linear(TOKEN, TOKEN) for _ in range(4))
        self.widen, self.narrow = nn.Linear(TOKEN, 2 * TOKEN), nn.Linear(2 * TOKEN, TOKEN)
        orthogonal(self)

    def rows(self, features: Tensor, masks: Tensor) -> Tensor:
        """(B, V, Z), (N, V) bool -> (N, B, 128)."""
        tokens = self.project(features) + self.place
        seen = self.norm1(tokens)
        query, key, value = (_heads(part(seen)) for part in (self.query, self.key, self.value))
        masks = masks.bool()
        allowed = masks[:, None, :].expand(-1, masks.shape[1], -1)
        answers = torch.stack([attend(query, key, value, one) for one in allowed])
        x = tokens + self.out(answers)
        x = x + self.narrow(F.gelu(self.widen(self.norm2(x))))
        present = masks.to(x.dtype)[:, None, :, None]
        return (x * present).sum(2) / present.sum(2).clamp(min=1)


def attend(query: Tensor, key: Tensor, value: Tensor, allowed: Tensor) -> Tensor:
    """softmax(q k^T / sqrt(d)) v over the ``allowed`` (T, T) pairs of T tokens, heads side by side.

    (B, heads, T, d) three times -> (B, T, heads * d).
    """
    scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
    shares = torch.softmax(scores.masked_fill(~allowed, _NEVER), -1)
    return (shares.to(value.dtype) @ value).transpose(1, 2).flatten(2)


def _heads(x: Tensor) -> Tensor:
    """(B, T, heads * d) -> (B, heads, T, d)."""
    return x.unflatten(-1, (HEADS, -1)).transpose(1, 2)
