"""A merge: the network by which features of several streams become one.

    views -- encode --> features -- rows(masks, noise) --> N merged features --> actor, critic

``encode`` runs once per time step, ``rows`` once per set of subsets. Every merge is one module in a
file of its own, with its options and, if it has one, its loss; ``merge_table.py`` has a row for
each. Stochastic merges (MVD, VIB) take their random tensor as argument ``noise``, so that the same
call gives the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Integer, Shaped, UInt8
from torch import Tensor, nn

from madviz.agent.networks import Actor, ActorHead, Critic, CriticHead, Encoder, NetworkConfig

Streams = tuple[str, ...]
Noise = Tensor | None
Heads = tuple[ActorHead, CriticHead]
Precision = Callable[[], torch.autocast]
"""Makes a context for mixed precision; one that was used remembers weights as it met them."""

_IMAGES_AT_ONCE = 192
"""On a CPU the allocator recycles temporaries of this size; it returns larger ones to the system
and allocates them again page by page: 768 images take half the time in four parts."""


class Merge(nn.Module):
    """The networks that the critic's loss trains besides the heads, and how they are read.

    The layout of features is a merge's own, except that their first axis is B. The rows that the
    heads read have axes (N, B, ...), one for every subset.
    """

    own_optimiser = ""
    """Name of the optimiser that steps these networks on a loss of their own: ``own_loss``, or
    ``reconstruction_loss`` of a merge that ``draws``; empty: there is none."""
    draws = False
    """True where the merge learns to draw pictures: it can show a missing camera's view."""
    foresees = False
    """True where the merge has a world model, which goes on without pictures."""

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        """``config.own`` holds the merge's own options."""
        super().__init__()
        self.streams = streams

    def heads(self, config: NetworkConfig) -> Heads:
        """Actor and critic for this merge's rows."""
        return Actor(config), Critic(config)

    def encode(self, views: Integer[Tensor, "B V C H W"]) -> Float[Tensor, "B ..."]:
        """Pixels to features: (B, V, Z) for a sum, else the merge's own layout. Pixels are uint8;
        in learning, unless the merge ``draws``, int8 that ``shift`` has centred."""
        raise NotImplementedError

    def rows(
        self, features: Float[Tensor, "B ..."], masks: Shaped[Tensor, "N V"], noise: Noise = None
    ) -> Float[Tensor, "N B ..."]:
        """The numbers that the heads read under each subset; ``masks`` are 0 and 1."""
        raise NotImplementedError

    def encode_and_merge(
        self, views: Integer[Tensor, "B V C H W"], masks: Shaped[Tensor, "N V"], noise: Noise = None
    ) -> tuple[Tensor, Float[Tensor, "N B ..."]]:
        """``encode`` and ``rows`` in one, for learning: features, and the rows from them. A merge
        that draws its views at random encodes no others, and its rows are all the features."""
        features = self.encode(views)
        return features, self.rows(features, masks, noise)

    def noise(self, batch: int, generator: torch.Generator) -> Noise:
        """The random tensor of ``rows`` for B samples, in learning; None: there is none."""
        return None

    def penalty(self, features: Tensor) -> Tensor | None:
        """A weighted scalar that is added to the loss that trains the encoder."""
        return None

    def own_loss(
        self, views: Tensor, next_views: Tensor, positive: int, precision: Precision
    ) -> Tensor:
        """A scalar for ``own_optimiser`` from (B, V, C, H, W) pictures of two time steps that
        follow each other; ``positive`` is a view drawn at random."""
        raise NotImplementedError

    # --- Acting and showing ---------------------------------------------------------------------

    def encode_to_act(self, views: Tensor) -> Tensor:
        """``encode`` for a policy, which may need more than training does."""
        return self.encode(views)

    def noise_to_act(self, views: Tensor) -> Noise:
        """``noise`` for a policy that must repeat itself: a function of the pictures."""
        return None

    def feature_of_each(self, features: Tensor) -> Tensor:
        """Features of a policy -> (B, V, Z), one row per stream, for showing."""
        return features

    def merged_feature(self, rows: Tensor) -> Tensor:
        """(N, B, ...) -> (N, B, Z), what the heads read as one feature, for showing."""
        return rows

    # --- Where ``draws`` or ``foresees`` ---------------------------------------------------------

    reconstructed = 0
    """Time steps whose pictures a gradient step of imitation learns to draw."""

    def set_mean(self, views: UInt8[Tensor, "B V C H W"]) -> None:
        """Before the first update: ``views`` show what is usual."""
        raise NotImplementedError

    def mean_pictures(self) -> Float[Tensor, "V 3 H W"]:
        """The usual picture of every view, from 0 to 1."""
        raise NotImplementedError

    def reconstruction_loss(
        self, views: Tensor, reward: Tensor, generator: torch.Generator
    ) -> Tensor:
        """A scalar for ``own_optimiser`` from (B, V, C, H, W) pictures as they were recorded and
        the rewards (B,) of these decisions."""
        raise NotImplementedError

    def imagined(self, features: Tensor, mask: Tensor) -> Float[Tensor, "B V 3 H W"]:
        """Every view's newest frame, from 0 to 1, drawn from the streams in ``mask`` (V,) alone."""
        raise NotImplementedError

    def foreseen(
        self, actor: ActorHead, features: Tensor, mask: Tensor, state: Tensor, decisions: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The likeliest course of T ``decisions``, begun from the state (B, S) and the streams in
        ``mask`` (V,): pictures after each, (T, B, V, 3, H, W) from 0 to 1, rewards (T, B), and
        actions (T, B, A)."""
        raise NotImplementedError


class SharedCnn(Merge, Encoder):
    """A merge whose only network is the CNN that all streams share."""

    def __init__(self, config: NetworkConfig, streams: Streams, frames: int = 0) -> None:
        """``frames`` on the channel axis; by default those of one stream's stack."""
        Encoder.__init__(self, frames or config.frame_stack)
        self.streams = streams

    def encode(self, views: Tensor) -> Tensor:
        return each_stream(self, views)


def each_stream(cnn: Callable[[Tensor], Tensor], views: Tensor) -> Tensor:
    """(B, V, C, H, W) uint8 -> (B, V, Z): every stream through the same network, in one pass."""
    images = views.flatten(0, 1)  # (B * V, C, H, W)
    parts = images.split(_IMAGES_AT_ONCE) if images.device.type == "cpu" else (images,)
    return torch.cat([cnn(part) for part in parts]).unflatten(0, views.shape[:2])  # (B, V, Z)


def wide_heads(config: NetworkConfig, width: int, projected: bool = True) -> Heads:
    """Actor and critic that read features of ``width`` numbers."""
    return Actor(config, width, projected), Critic(config, width, projected)
