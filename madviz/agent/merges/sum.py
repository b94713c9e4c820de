"""MAD's merge: the features of the streams that are present are summed.

Over the 3136 post-ReLU features, without averaging, view embeddings or mask tokens (paper, Merge
Module). A missing stream is simply not in the sum: with features of norm 8, 6 and 7 and the second
dropped, M = V_1 + V_3, exactly what a policy trained on two cameras would get. Singular and merged
features have the same size, so one actor reads both.
"""

from __future__ import annotations

import torch
from torch import Tensor

from madviz.agent.merges.base import Noise, SharedCnn


def merge_sum(features: Tensor, masks: Tensor) -> Tensor:
    """(B, V, Z) features, (N, V) masks of 0 and 1 -> (N, B, Z): every subset's merged feature."""
    return torch.einsum("nv,bvz->nbz", masks.to(features.dtype), features)


class Sum(SharedCnn):
    """See the file."""

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        return merge_sum(features, masks)
