"""Merging before everything else: all streams' pixels on the channel axis of one wider CNN."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from madviz.agent.merges.base import MergeFunctions, Noise, Streams
from madviz.agent.networks import FEATURE_SIZE, Encoder, NetworkConfig


def stacked_pixels(cnn: Encoder, views: Tensor) -> Tensor:
    """(B, V, C, H, W) uint8 -> (B, Z): one picture of V x C channels."""
    return cnn(views.flatten(1, 2))


class FrameStack(MergeFunctions):
    def networks(self, config: NetworkConfig, streams: Streams) -> Encoder:
        return Encoder(config.frame_stack * len(streams))

    def encode(self, net: Encoder, views: Tensor) -> Tensor:
        return stacked_pixels(net, views)

    def rows(self, net: Any, features: Tensor, masks: Tensor, noise: Noise) -> Tensor:
        return features.expand(len(masks), -1, -1)

    def feature_of_each(self, net: Any, features: Tensor, streams: Streams) -> Tensor:
        """No stream has a feature of its own: a page shows nothing for it."""
        return features.new_zeros(len(features), len(streams), FEATURE_SIZE)


FUNCTIONS = FrameStack()
