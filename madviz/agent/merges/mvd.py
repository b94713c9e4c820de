"""MVD: every view has a shared and a private part, separated by two contrastive losses.

Two CNNs, common to all views, each followed by Linear, LayerNorm and Tanh to 50 numbers:

    s_i = shared(V_i)    what any camera would show; pushed to agree between cameras
    p_i = private(V_i)   what this camera alone shows; pushed apart between cameras

A policy acts on [s_i, p_j] (100 numbers, no further trunk) for one view i and one view j, drawn
independently from the views that are present, the same for a whole batch. So it often sees one
camera alone in training (i = j), and losing cameras only narrows the draw. It never sees more than
two cameras at once, which is what it pays.

The losses (as the paper's code has them): a *positive* camera p is drawn, every other camera a is
an anchor, similarity is cos / 0.1, and keys are data (nothing is learned through them):

    shared    mean of two:  s_a(t) must find s_p(t) among the batch's s_p;
                            s_a(t) must find s_p(t) among it and all of its own sample's p_c(t)
    private   p_a(t) must find p_a(t+1) rather than p_p(t)

Worked: a sample whose positive has cosine 1 and whose single negative has cosine 0 costs
log(1 + exp(-10)) = 0.00005; the other way round it costs 10.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.merges.base import (
    Heads,
    Merge,
    Noise,
    Precision,
    Streams,
    each_stream,
    wide_heads,
)
from madviz.agent.networks import Encoder, NetworkConfig, Trunk, orthogonal

TEMPERATURE = 0.1


class HalfEncoder(nn.Module):
    """One of the two: the CNN, and its projection to 50 numbers."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.cnn = Encoder(config.frame_stack)
        self.trunk = Trunk(config)
        orthogonal(self.trunk)

    def forward(self, pixels: Tensor) -> Tensor:
        """(B, C, H, W) uint8 -> (B, 50)."""
        return self.trunk(self.cnn(pixels))


def split(features: Tensor) -> tuple[Tensor, Tensor]:
    """(..., 100) -> shared and private, (..., 50) each."""
    shared, private = features.chunk(2, -1)
    return shared, private


def drawn(masks: Tensor, keys: Tensor) -> Tensor:
    """Which views a subset's two parts come from: (N, V), (2, V) -> (2, N), i and j.

    ``keys`` are random numbers, one per part and view: the present view with the greatest key is
    taken. So subsets of one time step share a draw, and dropping a view that was not drawn changes
    nothing.
    """
    keys = keys.to(masks.device)
    return keys[:, None].masked_fill(~masks.bool(), -torch.inf).argmax(-1)


def shared_loss(anchor: Tensor, positive: Tensor, private: Tensor) -> Tensor:
    """s_a (B, Z), s_p (B, Z), private parts of all views (B, V, Z) -> scalar."""
    positive = positive.detach()
    private = private.detach()
    batch = _similarity(anchor[:, None], positive[None])  # (B, B)
    own = torch.arange(len(anchor), device=anchor.device)
    apart = _similarity(anchor[:, None], torch.cat([positive[:, None], private], 1))  # (B, 1 + V)
    return 0.5 * (F.cross_entropy(batch, own) + F.cross_entropy(apart, torch.zeros_like(own)))


def private_loss(anchor: Tensor, following: Tensor, other: Tensor) -> Tensor:
    """p_a(t), p_a(t+1), p_p(t), (B, Z) each -> scalar."""
    keys = torch.stack([following, other], 1).detach()
    first = torch.zeros(len(anchor), dtype=torch.long, device=anchor.device)
    return F.cross_entropy(_similarity(anchor[:, None], keys), first)


def contrastive_loss(features: Tensor, following: Tensor, positive: int) -> Tensor:
    """Shared plus private loss, averaged over the V - 1 anchors.

    ``features`` (B, V, 100) of o_t, ``following`` (B, V, 50) the private parts of o_{t+1},
    ``positive`` the index p.
    """
    shared, private = split(features)
    anchors = [a for a in range(features.shape[1]) if a != positive]
    losses = [
        shared_loss(shared[:, a], shared[:, positive], private)
        + private_loss(private[:, a], following[:, a], private[:, positive])
        for a in anchors
    ]
    return torch.stack(losses).mean()


def _similarity(a: Tensor, b: Tensor) -> Tensor:
    """cos(a, b) / temperature over the last axis; single precision at least, for the exponent."""
    if a.dtype == torch.bfloat16:
        a = a.float()
        b = b.float()
    return F.cosine_similarity(a, b, dim=-1) / TEMPERATURE


class TwoPartEncoder(Merge):
    """The shared and the private encoder."""

    own_optimiser = "contrast"

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        super().__init__(config, streams)
        self.shared = HalfEncoder(config)
        self.private = HalfEncoder(config)

    def heads(self, config: NetworkConfig) -> Heads:
        return wide_heads(config, 2 * config.feature_dim, projected=False)

    def forward(self, pixels: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, 100): shared, then private."""
        return torch.cat([self.shared(pixels), self.private(pixels)], -1)

    def encode(self, views: Tensor) -> Tensor:
        return each_stream(self, views)  # (B, V, 100)

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        """[s_i, p_j] of every subset: (B, V, 100), (N, V), (2, V) -> (N, B, 100)."""
        assert noise is not None
        shared, private = split(features)
        i, j = drawn(masks, noise)
        return torch.cat([shared[:, i], private[:, j]], -1).transpose(0, 1)

    def encode_and_merge(
        self, views: Tensor, masks: Tensor, noise: Noise = None
    ) -> tuple[Tensor, Tensor]:
        """Views that were not drawn are not encoded: the rows are all the features there are."""
        assert noise is not None
        rows = []
        for i, j in drawn(masks, noise).T.tolist():
            shared = each_stream(self.shared, views[:, [i]])  # (B, 1, 50)
            private = each_stream(self.private, views[:, [j]])
            rows.append(torch.cat([shared, private], -1)[:, 0])  # (B, 100)
        merged = torch.stack(rows)  # (N, B, 100)
        return merged, merged

    def noise(self, batch: int, generator: torch.Generator) -> Tensor:
        """(2, V) uniform: the keys of ``drawn``, one draw for the whole batch."""
        return torch.rand(2, len(self.streams), generator=generator)

    def noise_to_act(self, views: Tensor) -> Tensor:
        """An episode stays a function of its seed, and a draw still changes from step to step. The
        keys of a view come from its own pixels: what a dropped camera would show changes nothing.
        """
        sums = views.sum((0, 2, 3, 4), dtype=torch.int64).tolist()
        keys = [np.random.default_rng(seed).random(2, np.float32) for seed in enumerate(sums)]
        return torch.from_numpy(np.stack(keys, 1))  # (2, V)

    def own_loss(
        self, views: Tensor, next_views: Tensor, positive: int, precision: Precision
    ) -> Tensor:
        with precision():
            features = self.encode(views)
        # Keys carry no gradient, and no context with gradients may meet what was made without.
        with torch.no_grad(), precision():
            following = each_stream(self.private, next_views)
        return contrastive_loss(features, following, positive)
