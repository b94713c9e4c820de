"""Learned questions to the tokens of an autoencoder: what a policy or a world model reads of them.

However many tokens there are, as many numbers come out, so any set of views can be read:

    K tokens of 128 numbers --8 questions, 4 heads--> 8 x 128 = 1024 numbers
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

QUESTIONS = 8
HEADS = 4


class TokenReader(nn.Module):
    """Learned questions to tokens: attention whose queries are parameters."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.questions = nn.Parameter(torch.randn(QUESTIONS, width))
        self.key, self.value = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, K, W) -> (B, 8 W)."""
        query = self.questions.to(tokens.dtype).expand(len(tokens), -1, -1)
        query, key, value = map(_split, (query, self.key(tokens), self.value(tokens)))
        return F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(1)


def _split(x: Tensor) -> Tensor:
    """(B, K, W) -> (B, heads, K, W / heads)."""
    return x.unflatten(-1, (HEADS, -1)).transpose(1, 2)
