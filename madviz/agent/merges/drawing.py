"""Merges whose network learns to draw pictures, and what they share (``mv_mae``, ``mv_mwm``).

    tokens of the streams that are present -- encoder --> their features -- decoder --> every view
                                                                  \\-- read --> a row for the heads

Such a merge learns from pictures, with a loss of its own, and can be asked what a missing camera
would see. A merge says here only which of its tokens belong to a subset and how it reads them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from madviz.agent.autoencoder import autoencoder_loss, whole_views
from madviz.agent.merges.base import MergeFunctions, Noise
from madviz.agent.networks import ActorHead


class DrawingMerge(MergeFunctions):
    """See the module. Its ``net`` has a ``MultiViewAutoencoder`` as ``autoencoder``."""

    own_optimiser = "reconstruction"

    def present(self, features: Tensor, mask: Bool[Tensor, " V"]) -> Tensor:
        """Features -> (..., B, K, W): the tokens of the streams in ``mask``."""
        raise NotImplementedError

    def read(self, net: Any, tokens: Tensor) -> Tensor:
        """(N, ..., B, K, W) tokens of N subsets of as many streams -> their rows (N, B, ...)."""
        raise NotImplementedError

    def seen(self, net: Any, features: Tensor, mask: Tensor) -> Float[Tensor, "B K W"]:
        """The newest frame's tokens of a subset, each having seen the others."""
        raise NotImplementedError

    def rows(self, net: Any, features: Tensor, masks: Tensor, noise: Noise) -> Tensor:
        """Subsets of as many streams go through the networks together."""
        rows: dict[int, Tensor] = {}
        for size in masks.sum(1).unique():
            which = (masks.sum(1) == size).nonzero().flatten().tolist()
            tokens = torch.stack([self.present(features, masks[n].bool()) for n in which])
            rows.update(zip(which, self.read(net, tokens), strict=True))
        return torch.stack([rows[n] for n in range(len(masks))])

    def set_mean(self, net: Any, mean: Float[Tensor, "V 3 H W"]) -> None:
        """Before the first update: the mean picture of every view, from 0 to 1."""
        net.autoencoder.mean.copy_(mean)

    def mean_pictures(self, net: Any) -> Float[Tensor, "V 3 H W"]:
        """What ``set_mean`` was given."""
        return net.autoencoder.mean

    def reconstruction_loss(
        self, net: Any, views: Tensor, reward: Tensor, generator: torch.Generator
    ) -> Tensor:
        """A scalar for ``own_optimiser`` from (B, V, C, H, W) pictures as they were recorded and
        the rewards (B,) of these decisions."""
        newest = views[:, :, -net.autoencoder.channels :]
        return autoencoder_loss(net.autoencoder, newest, reward, generator)

    def imagined(self, net: Any, features: Tensor, mask: Tensor) -> Float[Tensor, "B V 3 H W"]:
        """Every view's newest frame, from 0 to 1, drawn from the streams in ``mask`` (V,) alone."""
        model = net.autoencoder
        keep = whole_views(mask.bool(), model.tokens_of_a_view, len(features))
        return model.draw(self.seen(net, features, mask.bool()), keep).pictures.clamp(0, 1)


@dataclass(frozen=True)
class Foreseen:
    """T imagined decisions of B samples."""

    pictures: Float[Tensor, "T B V 3 H W"]
    """After each decision, from 0 to 1."""
    reward: Float[Tensor, "T B"]
    action: Float[Tensor, "T B A"]


class ForeseeingMerge(DrawingMerge):
    """One that can also go on without pictures."""

    def foreseen(
        self,
        net: Any,
        actor: ActorHead,
        features: Tensor,
        mask: Tensor,
        state: Float[Tensor, "B S"],
        decisions: int,
    ) -> Foreseen:
        """The likeliest course, begun from the streams in ``mask`` (V,) alone."""
        raise NotImplementedError
