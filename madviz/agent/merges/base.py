"""What a merge computes: the functions by which features of several streams become one.

    views -- encode --> features -- rows(masks, noise) --> N merged features --> actor, critic

``encode`` runs once per time step, ``rows`` once per set of subsets. Every merge has a file beside
this one with its networks, its functions and, if it has one, its own loss; ``table.py`` has a row
for each. Stochastic merges (MVD, VIB) take their random tensor as argument ``noise``, so all
functions are pure.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from madviz.agent.networks import Actor, ActorHead, Critic, CriticHead, Encoder, NetworkConfig

Streams = tuple[str, ...]
Noise = Tensor | None
Heads = tuple[ActorHead, CriticHead]
Precision = Callable[[], torch.autocast]
"""Makes a context for mixed precision; one that was used remembers weights as it met them."""

_IMAGES_AT_ONCE = 192
"""On a CPU: temporaries of this size are recycled by the allocator; larger ones are returned to the
system and allocated again page by page: 768 images take half the time in four parts."""


class MergeFunctions:
    """The functions of one merge; the defaults are those of a shared CNN and one pair of heads.

    ``net`` is what ``networks`` made. The layout of features is a merge's own, except that their
    first axis is B; the rows that the heads read have axes (N, B, ...), one for every subset.
    """

    own_optimiser = ""
    """Name of the optimiser that steps the encoder on a loss of the merge's own: ``own_loss``, or
    that of a ``DrawingMerge``; empty: there is none."""

    def networks(self, config: NetworkConfig, streams: Streams) -> nn.Module:
        """What the critic's loss trains besides the heads."""
        return Encoder(config.frame_stack)

    def heads(self, config: NetworkConfig, streams: Streams) -> Heads:
        """Actor and critic for this merge's rows."""
        return Actor(config), Critic(config)

    def encode(self, net: Any, views: Tensor) -> Tensor:
        """(B, V, C, H, W) uint8 -> features."""
        return each_stream(net, views)

    def rows(self, net: Any, features: Tensor, masks: Tensor, noise: Noise) -> Tensor:
        """Features, masks (N, V) -> (N, B, ...), what the heads read under every subset."""
        raise NotImplementedError

    def encode_and_merge(
        self, net: Any, views: Tensor, masks: Tensor, noise: Noise
    ) -> tuple[Tensor, Tensor]:
        """``encode`` and ``rows`` in one, for learning: features, and the rows from them."""
        features = self.encode(net, views)
        return features, self.rows(net, features, masks, noise)

    def noise(
        self, config: NetworkConfig, streams: Streams, batch: int, generator: torch.Generator
    ) -> Noise:
        """What ``rows`` draws for B samples, for learning and exploring; None: nothing."""
        return None

    def penalty(self, net: Any, features: Tensor) -> Tensor | None:
        """A scalar that is added, times ``kl_weight``, to the loss that trains the encoder."""
        return None

    def own_loss(
        self, net: Any, views: Tensor, next_views: Tensor, positive: int, precision: Precision
    ) -> Tensor:
        """A scalar for ``own_optimiser`` from (B, V, C, H, W) pictures of two time steps that
        follow each other; ``positive`` is a view drawn at random."""
        raise NotImplementedError

    def encode_to_act(self, net: Any, views: Tensor) -> Tensor:
        """``encode`` for a policy, which may need more than training does."""
        return self.encode(net, views)

    def noise_to_act(self, views: Tensor) -> Noise:
        """``noise`` for a policy that must repeat itself: a function of the pictures."""
        return None

    def feature_of_each(self, net: Any, features: Tensor, streams: Streams) -> Tensor:
        """Features of a policy -> (B, V, Z), one row per stream, for showing."""
        return features

    def merged_feature(self, rows: Tensor) -> Tensor:
        """(N, B, ...) -> (N, B, Z), what the heads read as one feature, for showing."""
        return rows


def each_stream(cnn: Callable[[Tensor], Tensor], views: Tensor) -> Tensor:
    """(B, V, C, H, W) uint8 -> (B, V, Z): every stream through the same network, in one pass."""
    images = views.flatten(0, 1)
    parts = images.split(_IMAGES_AT_ONCE) if images.device.type == "cpu" else (images,)
    return torch.cat([cnn(part) for part in parts]).unflatten(0, views.shape[:2])


def wide_heads(config: NetworkConfig, width: int, projected: bool = True) -> Heads:
    """Actor and critic that read features of ``width`` numbers."""
    return Actor(config, width, projected), Critic(config, width, projected)
