"""Features side by side: V x 3136 numbers go into the heads' trunks, and none may be missing."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from madviz.agent.merges.base import Heads, MergeFunctions, Noise, Streams, wide_heads
from madviz.agent.networks import FEATURE_SIZE, NetworkConfig


def concatenated(features: Tensor, masks: Tensor) -> Tensor:
    """(B, V, Z) -> (N, B, V * Z); the only mask there can be is the full one."""
    return features.flatten(1).expand(len(masks), -1, -1)


class Concat(MergeFunctions):
    def heads(self, config: NetworkConfig, streams: Streams) -> Heads:
        return wide_heads(config, len(streams) * FEATURE_SIZE)

    def rows(self, net: Any, features: Tensor, masks: Tensor, noise: Noise) -> Tensor:
        return concatenated(features, masks)


FUNCTIONS = Concat()
