"""Features side by side: V x 3136 numbers go into the heads' trunks, and none may be missing."""

from __future__ import annotations

from torch import Tensor

from madviz.agent.merges.base import Heads, Noise, SharedCnn, wide_heads
from madviz.agent.networks import FEATURE_SIZE, NetworkConfig


def concatenated(features: Tensor, masks: Tensor) -> Tensor:
    """(B, V, Z) -> (N, B, V * Z); the only mask there can be is the full one."""
    return features.flatten(1).expand(len(masks), -1, -1)


class Concat(SharedCnn):
    """See the file."""

    def heads(self, config: NetworkConfig) -> Heads:
        return wide_heads(config, len(self.streams) * FEATURE_SIZE)

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        return concatenated(features, masks)
