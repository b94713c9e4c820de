"""A masked autoencoder over views: what a camera that is missing would see (Seo et al., 2023).

The problem: a policy that has lost a camera still knows something of what that camera would show,
from the others. A policy that acts cannot be asked; a network that draws pictures can.

The idea: cut every view into patches, hide most of them and some views as a whole, and learn to
draw all of them from the rest. What can be drawn of a hidden view is what the others tell of it.

    views (V, C, H, W) -- stem --> V x T tokens -- keep K of them --> transformer --> K features
    K features, and a mark for each token that was left out -- decoder --> V pictures, and reward

    84 pixels, patches of 14: T = 36 tokens a view, 108 for three. Two views kept whole: K = 72.

Pictures are drawn as a difference to each camera's mean over the training frames. A network that
has learned nothing then draws the mean, which is the control that it must be better than. Most
pixels never change, so a plain squared error learns the background and not the hand: pixels that
move count ``moving_weight`` times more.

Unlike the authors' code: views are hidden uniformly, and the share of tokens that is kept varies up
to whole views (a network that was trained on 7 % of the tokens gets worse when it is given more);
only the newest frame of a stack is drawn; positions are fixed, views have learned marks.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from madviz.system.numbers import Count, Pixels, Weight, Width

MOVING = 10 / 255
"""A pixel moves where a channel differs by more than this from its camera's mean."""
LEAST_KEPT = 0.3
"""Share of the tokens of visible views that is kept at least, where not all are."""


@dataclass(frozen=True)
class AutoencoderConfig:
    """The sizes of the autoencoder: light ones, the paper's are in brackets."""

    patch: Pixels = 14
    """Pixels of a patch's side (16 of 96)."""
    width: Width = 128
    """Numbers of a token (256)."""
    layers: Count = 4
    """Transformer layers of the encoder (8)."""
    decoder_layers: Count = 2
    """Transformer layers of the decoder (6)."""
    heads: Count = 4
    """Attention heads of both (4)."""
    moving_weight: Weight = 20.0
    """How much more a pixel that moves counts (0)."""


@dataclass(frozen=True)
class Drawn:
    """What the decoder makes of a set of tokens."""

    pictures: Float[Tensor, "B V 3 H W"]
    """The newest frame of every view, visible or not, 0 to 1 but for what is drawn wrong."""
    reward: Float[Tensor, " B"]
    """Symlog of the reward of the present decision."""


class MultiViewAutoencoder(nn.Module):
    """See the module."""

    mean: Tensor
    place: Tensor

    def __init__(
        self, config: AutoencoderConfig, channels: int, mean: Float[Tensor, "V 3 H W"]
    ) -> None:
        """``channels``: C, three for each frame of the stack. ``mean``: the mean picture of every
        view over the training frames, 0 to 1. Raises ValueError where patches do not fit."""
        super().__init__()
        views, _, size, _ = mean.shape
        if size % config.patch or config.patch % 2:
            raise ValueError(f"a picture of {size} pixels has no even patches of {config.patch}")
        self.config, self.side = config, size // config.patch
        width = config.width
        self.stem = nn.Sequential(
            nn.Conv2d(channels, width // 2, 2, stride=2),
            nn.GELU(),
            nn.Conv2d(width // 2, width, config.patch // 2, stride=config.patch // 2),
        )
        """Reads each patch alone: nothing of a hidden patch shows in its neighbours."""
        self.view = nn.Parameter(0.02 * torch.randn(views, 1, width))
        self.hidden = nn.Parameter(0.02 * torch.randn(width))
        self.register_buffer("place", positions(self.side, width), persistent=False)
        self.register_buffer("mean", mean.clone())
        self.encoder = _layers(config, config.layers)
        self.decoder = _layers(config, config.decoder_layers)
        self.norm, self.draw_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.pixels = nn.Linear(width, 3 * config.patch**2)
        self.reward = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1))
        nn.init.zeros_(self.pixels.weight)
        nn.init.zeros_(self.pixels.bias)

    @property
    def tokens_of_a_view(self) -> int:
        """T."""
        return self.side**2

    def tokens(self, views: UInt8[Tensor, "B V C H W"]) -> Float[Tensor, "B M W"]:
        """The M = V T tokens of all views, each from its own patch alone."""
        maps = self.stem(views.flatten(0, 1).to(self.view.dtype) / 255 - 0.5)
        tokens = maps.flatten(2).transpose(1, 2).unflatten(0, views.shape[:2])
        return (tokens + self.place + self.view).flatten(1, 2)

    def features(
        self, tokens: Float[Tensor, "B M W"], keep: Int[Tensor, "B K"]
    ) -> Float[Tensor, "B K W"]:
        """Of the tokens that are kept, each having seen the others that are."""
        return self.norm(self.encoder(_taken(tokens, keep)))

    def draw(self, features: Float[Tensor, "B K W"], keep: Int[Tensor, "B K"]) -> Drawn:
        """Every view's picture, and the reward, from what was kept."""
        batch, width = len(features), self.config.width
        marks = (self.hidden + self.place + self.view).flatten(0, 1)
        everything = marks.expand(batch, -1, -1).to(features.dtype)
        where = keep[..., None].expand(-1, -1, width)
        seen = features + marks.to(features.dtype)[keep]
        everything = everything.scatter(1, where, seen)
        patches = self.pixels(self.draw_norm(self.decoder(everything))).float()
        difference = pictures_of(patches.unflatten(1, (len(self.mean), -1)), self.config.patch)
        reward = self.reward(features.mean(1)).squeeze(-1).float()
        return Drawn(self.mean + difference, reward)

    def forward(self, views: UInt8[Tensor, "B V C H W"], keep: Int[Tensor, "B K"]) -> Drawn:
        """What is drawn where the tokens ``keep`` are seen."""
        return self.draw(self.features(self.tokens(views), keep), keep)


def _layers(config: AutoencoderConfig, count: int) -> nn.TransformerEncoder:
    layer = nn.TransformerEncoderLayer(
        config.width,
        config.heads,
        4 * config.width,
        dropout=0.0,
        activation="gelu",
        batch_first=True,
        norm_first=True,
    )
    return nn.TransformerEncoder(layer, count, enable_nested_tensor=False)


def _taken(tokens: Tensor, keep: Tensor) -> Tensor:
    return tokens.gather(1, keep[..., None].expand(-1, -1, tokens.shape[-1]))


# --- Which tokens are kept ----------------------------------------------------------------------


def whole_views(mask: Bool[Tensor, " V"], tokens: int, batch: int = 1) -> Int[Tensor, "B K"]:
    """All ``tokens`` of each view in ``mask``, for every sample."""
    kept = mask.repeat_interleave(tokens).nonzero().flatten()
    return kept.expand(batch, -1)


def drawn_tokens(
    generator: torch.Generator, batch: int, views: int, tokens: int
) -> Int[Tensor, "B K"]:
    """Tokens to keep in a training batch: of one to all views, the same number for every sample,
    other views for each; in a third of the batches all of their tokens, else a share of them that
    is uniform between ``LEAST_KEPT`` and 1. A function of ``generator`` alone.
    """
    visible = int(torch.randint(1, views + 1, (), generator=generator))
    share = float(torch.rand((), generator=generator)) * 1.5
    share = 1.0 if share >= 1 else LEAST_KEPT + share * (1 - LEAST_KEPT)
    count = max(1, round(share * visible * tokens))
    order = torch.rand(batch, views, generator=generator).argsort(1).argsort(1)
    luck = torch.rand(batch, views, tokens, generator=generator)
    luck[order >= visible] = 2.0  # Behind all others.
    return luck.flatten(1).argsort(1)[:, :count].sort(1).values


# --- Losses -------------------------------------------------------------------------------------


def moving(
    pictures: Float[Tensor, "B V 3 H W"], mean: Float[Tensor, "V 3 H W"]
) -> Bool[Tensor, "B V H W"]:
    """Which pixels differ from their camera's mean by more than ``MOVING`` in some channel."""
    return ((pictures - mean).abs() > MOVING).any(2)


def reconstruction_loss(
    drawn: Float[Tensor, "B V 3 H W"],
    pictures: Float[Tensor, "B V 3 H W"],
    moves: Bool[Tensor, "B V H W"],
    moving_weight: float,
) -> Float[Tensor, ""]:
    """Squared error, a mean over pixels in which those that move count 1 + ``moving_weight``."""
    weight = 1 + moving_weight * moves.to(drawn.dtype)
    error = (drawn - pictures).square().mean(2)
    return (weight * error).sum() / weight.sum()


def symlog(x: Tensor) -> Tensor:
    """sign(x) log(1 + |x|): rewards of any size in a range that a network can give."""
    return x.sign() * x.abs().log1p()


def psnr(
    drawn: Float[Tensor, "B V 3 H W"],
    pictures: Float[Tensor, "B V 3 H W"],
    where: Bool[Tensor, "B V H W"],
) -> Float[Tensor, "B V"]:
    """Peak signal-to-noise ratio in dB over the pixels ``where``, of pictures from 0 to 1; NaN
    where there are none. An error of 0.1 everywhere has 20 dB, one of 0.01 has 40."""
    error = (drawn.clamp(0, 1) - pictures).square().mean(2)
    mean = (error * where).sum((2, 3)) / where.sum((2, 3))
    return -10 * mean.log10()


# --- Patches ------------------------------------------------------------------------------------


def positions(side: int, width: int) -> Float[Tensor, "T W"]:
    """Fixed marks of ``side`` x ``side`` places: sines and cosines of row and of column, a quarter
    of ``width`` each, with wave lengths from 2 pi to 20,000 pi."""
    quarter = width // 4
    rates = 10_000 ** (-torch.arange(quarter) / quarter)
    row, column = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    angles = [place.flatten()[:, None] * rates for place in (row, column)]
    return torch.cat([wave(angle) for angle in angles for wave in (torch.sin, torch.cos)], 1)


def pictures_of(patches: Float[Tensor, "B V T P"], patch: int) -> Float[Tensor, "B V 3 H W"]:
    """Puts T patches of 3 x ``patch`` x ``patch`` numbers into their places, row by row."""
    batch, views, tokens, _ = patches.shape
    side = round(tokens**0.5)
    grid = patches.reshape(batch, views, side, side, 3, patch, patch)
    return grid.permute(0, 1, 4, 2, 5, 3, 6).reshape(batch, views, 3, side * patch, side * patch)
