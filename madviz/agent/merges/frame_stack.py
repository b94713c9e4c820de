"""Merging before everything else: all streams' pixels on the channel axis of one wider CNN."""

from __future__ import annotations

from torch import Tensor

from madviz.agent.merges.base import Noise, SharedCnn, Streams
from madviz.agent.networks import FEATURE_SIZE, Encoder, NetworkConfig


def stacked_pixels(cnn: Encoder, views: Tensor) -> Tensor:
    """(B, V, C, H, W) uint8 -> (B, Z): one picture of V x C channels."""
    return cnn(views.flatten(1, 2))


class FrameStack(SharedCnn):
    """See the file."""

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        super().__init__(config, streams, config.frame_stack * len(streams))

    def encode(self, views: Tensor) -> Tensor:
        return stacked_pixels(self, views)  # (B, Z)

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        return features.expand(len(masks), -1, -1)  # (N, B, Z); every mask is the full one

    def feature_of_each(self, features: Tensor) -> Tensor:
        """No stream has a feature of its own: a page shows nothing for it."""
        return features.new_zeros(len(features), len(self.streams), FEATURE_SIZE)
