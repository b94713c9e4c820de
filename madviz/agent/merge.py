"""How features of several streams become one: a table of merges with one small interface.

    views -- encode --> features -- rows(masks, luck) --> N merged features --> actor, critic

``encode`` runs once per instant, ``rows`` once per set of subsets. MAD sums the streams that are
present: over the 3136 post-ReLU features, without averaging, view embeddings or mask tokens (paper,
Merge Module). A missing stream is simply not in it: with features of norm 8, 6 and 7 and the second
dropped, M = V_1 + V_3, exactly what a policy trained on two cameras would get. Singular and merged
features have the same size, so one actor reads both. The others, early to late:

    frame-stack  all streams' pixels on the channel axis of one wider CNN
    concat       features side by side, V x 3136 into the trunk
    attention    features look at each other, then are summed              (attention.py)
    vit          one token per stream through a transformer layer          (attention.py)
    mvd          one drawn stream's shared part beside another's private   (contrast.py)
    vib          side by side, third-person ones through a bottleneck      (bottleneck.py)
    q-mean       not merged at all: actions and Q are averaged             (per_view.py)

What a merge cannot do without is in ``supports.py``. *Luck* is the randomness of a merge that has
some (MVD's draw, VIB's noise); it is an argument, so that every function here is pure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from madviz.agent.attention import TOKEN, CrossAttention, ViewTransformer
from madviz.agent.bottleneck import BottleneckEncoder, bottleneck_width, third_person
from madviz.agent.contrast import TwoPartEncoder, draw_rows, drawn
from madviz.agent.networks import FEATURE_SIZE, Actor, Critic, Encoder, NetworkConfig
from madviz.agent.per_view import PerViewActor, PerViewCritic, mean_feature, pack
from madviz.errors import unknown

Streams = tuple[str, ...]
Luck = Tensor | None
Heads = tuple[Actor | PerViewActor, Critic | PerViewCritic]

_IMAGES_AT_ONCE = 192
"""Temporaries of this size are recycled by the allocator; larger ones are returned to the system
and paid for again, page by page: 768 images take half the time in four parts."""


def merge_sum(features: Tensor, masks: Tensor) -> Tensor:
    """(B, V, Z) features, (N, V) masks of 0 and 1 -> (N, B, Z): every subset's merged feature."""
    return torch.einsum("nv,bvz->nbz", masks.to(features.dtype), features)


def each_stream(cnn: Callable[[Tensor], Tensor], views: Tensor) -> Tensor:
    """(B, V, C, H, W) uint8 -> (B, V, Z): every stream through the same network, in one pass."""
    parts = views.flatten(0, 1).split(_IMAGES_AT_ONCE)
    return torch.cat([cnn(part) for part in parts]).unflatten(0, views.shape[:2])


def concatenated(features: Tensor, masks: Tensor) -> Tensor:
    """(B, V, Z) -> (N, B, V * Z); the only mask there can be is the full one."""
    return features.flatten(1).expand(len(masks), -1, -1)


def stacked_pixels(cnn: Encoder, views: Tensor) -> Tensor:
    """(B, V, C, H, W) uint8 -> (B, Z): one picture of V x C channels."""
    return cnn(views.flatten(1, 2))


def drawn_pixels(net: TwoPartEncoder, views: Tensor, masks: Tensor, keys: Luck) -> Tensor:
    """``draw_rows`` from (B, V, C, H, W) pixels: only the two views that were drawn are encoded."""
    assert keys is not None
    pairs = drawn(masks, keys).T.tolist()
    rows = [
        [each_stream(net.shared, views[:, [i]]), each_stream(net.private, views[:, [j]])]
        for i, j in pairs
    ]
    return torch.stack([torch.cat(row, -1)[:, 0] for row in rows])


@dataclass(frozen=True)
class Merge:
    """One row of the table. The defaults are MAD's; ``net`` is whatever ``networks`` made.

    The layout of features is a merge's own, except that its first axis is B.
    """

    summary: str
    networks: Callable[[NetworkConfig, Streams], nn.Module] = lambda config, streams: Encoder(
        config.frame_stack
    )
    """What the critic's loss trains besides the heads."""
    encode: Callable[[Any, Tensor], Tensor] = each_stream
    """(net, views (B, V, C, H, W) uint8) -> features."""
    rows: Callable[[Any, Tensor, Tensor, Luck], Tensor] = lambda net, features, masks, luck: (
        merge_sum(features, masks)
    )
    """(net, features, masks (N, V), luck) -> (N, B, width), what the heads read."""
    rows_of_pixels: Callable[[Any, Tensor, Tensor, Luck], Tensor] | None = None
    """(net, views, masks, luck) -> rows, where that is cheaper than by way of all features."""
    heads: Callable[[NetworkConfig, Streams], Heads] = lambda config, streams: (
        Actor(config),
        Critic(config),
    )
    """Actor and critic for this merge's rows."""
    luck: Callable[[Streams, NetworkConfig, int, torch.Generator], Luck] = lambda *_: None
    """What ``rows`` draws for B samples, for learning and for exploring."""
    encode_to_act: Callable[[Any, Tensor], Tensor] | None = None
    """``encode`` for a policy, where that needs more than training does."""
    luck_to_act: Callable[[Streams, Tensor], Luck] = lambda streams, views: None
    """The same for a policy that must repeat itself: a function of the pictures."""
    shown: Callable[[Any, Tensor, Streams], Tensor] = lambda net, features, streams: features
    """Features of a policy -> (B, V, Z), one row per stream."""
    shown_merged: Callable[[Tensor], Tensor] = lambda rows: rows
    """What the heads read -> (N, B, Z), as one feature."""


def _wide_heads(width: Callable[[NetworkConfig, Streams], int], projected: bool = True) -> Any:
    def heads(config: NetworkConfig, streams: Streams) -> Heads:
        size = width(config, streams)
        return Actor(config, size, projected), Critic(config, size, projected)

    return heads


def _bottleneck_noise(
    streams: Streams, config: NetworkConfig, batch: int, generator: torch.Generator
) -> Tensor:
    """(B, T, latent) standard normal; the first-person streams need none."""
    third = len(third_person(streams))
    return torch.randn(batch, third, config.bottleneck_dim, generator=generator)


def _draw_from_pictures(streams: Streams, views: Tensor) -> Tensor:
    """An episode stays a function of its seed, and a draw still changes from step to step."""
    rng = np.random.default_rng(int(views.sum(dtype=torch.int64)))
    return torch.from_numpy(rng.random((2, len(streams)), np.float32))


MERGES: dict[str, Merge] = {
    "sum": Merge("features are summed"),
    "concat": Merge(
        "features stand side by side",
        rows=lambda net, features, masks, luck: concatenated(features, masks),
        heads=_wide_heads(lambda config, streams: len(streams) * FEATURE_SIZE),
    ),
    "frame-stack": Merge(
        "pixels are stacked on the channel axis of one encoder",
        networks=lambda config, streams: Encoder(config.frame_stack * len(streams)),
        encode=stacked_pixels,
        rows=lambda net, features, masks, luck: features.expand(len(masks), -1, -1),
        # No stream has a feature of its own: a page shows nothing for it.
        shown=lambda net, features, streams: features.new_zeros(
            len(features), len(streams), FEATURE_SIZE
        ),
    ),
    "attention": Merge(
        "features attend to those of the other views, then are summed",
        networks=lambda config, streams: CrossAttention(config.frame_stack),
        encode=lambda net, views: each_stream(net.cnn, views),
        rows=lambda net, features, masks, luck: net.rows(features, masks),
    ),
    "vit": Merge(
        "one token per view through a transformer layer, then their mean",
        networks=lambda config, streams: ViewTransformer(config.frame_stack, len(streams)),
        encode=lambda net, views: each_stream(net.cnn, views),
        rows=lambda net, features, masks, luck: net.rows(features, masks),
        heads=_wide_heads(lambda config, streams: TOKEN),
    ),
    "q-mean": Merge(
        "every view is judged alone; actions and Q are averaged",
        rows=lambda net, features, masks, luck: pack(features, masks),
        heads=lambda config, streams: (PerViewActor(config), PerViewCritic(config)),
        shown_merged=mean_feature,
    ),
    "mvd": Merge(
        "the shared part of one drawn view beside the private part of another",
        networks=lambda config, streams: TwoPartEncoder(config),
        rows=lambda net, features, masks, keys: draw_rows(features, masks, keys),
        rows_of_pixels=drawn_pixels,
        heads=_wide_heads(lambda config, streams: 2 * config.feature_dim, projected=False),
        luck=lambda streams, config, batch, generator: torch.rand(
            2, len(streams), generator=generator
        ),
        luck_to_act=_draw_from_pictures,
    ),
    "vib": Merge(
        "side by side, third-person views through a noisy bottleneck",
        networks=BottleneckEncoder,
        encode=lambda net, views: net.own(views),
        rows=lambda net, features, masks, noise: net.rows(features, masks, noise),
        heads=_wide_heads(bottleneck_width),
        luck=_bottleneck_noise,
        encode_to_act=lambda net, views: net.everywhere(views),
        shown=lambda net, features, streams: net.shown(features),
    ),
}
"""Name of a merge -> its row; ``supports.py`` has the same names."""


def merge_called(name: str) -> Merge:
    """The merge called ``name``. Raises UserError listing the known ones."""
    if name not in MERGES:
        raise unknown("merge", name, list(MERGES))
    return MERGES[name]
