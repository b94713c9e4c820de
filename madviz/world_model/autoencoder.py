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
only the newest frame of a stack is drawn; the vectors that mark places and views begin as sines and
cosines, and are learned; every view counts alike in the loss. The last two are what it took here to
imagine a hand of a few pixels within minutes (``benchmarks/imagine.py`` has the figures).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.merges.attention import split_heads
from madviz.agent.sizes import MOVING
from madviz.world_model.sizes import AutoencoderConfig

LEAST_KEPT = 0.3
"""Share of the tokens of visible views that is kept at least, where not all are."""
REWARD_WEIGHT = 0.01
"""Weight of the squared error of the reward's symlog, beside the pictures'."""
QUESTIONS = 8
"""Questions that a policy or a world model asks the tokens."""


@dataclass(frozen=True)
class Drawn:
    """The decoder's output for a set of tokens."""

    pictures: Float[Tensor, "B V 3 H W"]
    """The newest frame of every view, visible or not, 0 to 1 but for what is drawn wrong."""
    reward: Float[Tensor, " B"]
    """Symlog of the reward of the present decision."""


class MultiViewAutoencoder(nn.Module):
    """See the module."""

    mean: Tensor

    def __init__(
        self, config: AutoencoderConfig, channels: int, mean: Float[Tensor, "V 3 H W"]
    ) -> None:
        """``channels``: C, three for each frame of the stack. ``mean``: the mean picture of every
        view over the training frames, 0 to 1. Raises ValueError where patches do not fit."""
        super().__init__()
        views, _, size, _ = mean.shape
        if size % config.patch:
            raise ValueError(f"a picture of {size} pixels has no whole patches of {config.patch}")
        self.config = config
        self.channels = channels
        self.side = size // config.patch
        width = config.width
        places = (config.patch // 2) ** 2
        self.stem = nn.Sequential(
            nn.Linear(4 * channels, width // 4),
            nn.ReLU(),
            nn.Flatten(-2),
            nn.Linear(places * (width // 4), width),
        )
        """Two convolutions whose strides are their sizes: squares of 2 x 2 pixels, then the patch.
        Each patch is read alone, so that nothing of a hidden one shows in its neighbours, and the
        hidden ones need not be read at all."""
        place = positions(self.side, width)
        self.marks = nn.Parameter(torch.cat([place + 0.02 * torch.randn(width) for _ in mean]))
        """(M, W), what tells the M = V T places from each other."""
        self.hidden = nn.Parameter(0.02 * torch.randn(width))
        self.register_buffer("mean", mean.clone())
        self.encoder = _layers(config, config.layers)
        self.decoder = _layers(config, config.decoder_layers)
        self.norm = nn.LayerNorm(width)
        self.draw_norm = nn.LayerNorm(width)
        self.pixels = nn.Linear(width, 3 * config.patch**2)
        self.reward = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1))
        nn.init.zeros_(self.pixels.weight)
        nn.init.zeros_(self.pixels.bias)

    @property
    def tokens_of_a_view(self) -> int:
        """T."""
        return self.side**2

    def tokens(
        self, views: UInt8[Tensor, "B V C H W"], keep: Int[Tensor, "B K"]
    ) -> Float[Tensor, "B K W"]:
        """The tokens that are kept, each from its own patch alone."""
        squares = _taken(squares_of(views, self.config.patch).flatten(2), keep)
        return self._read(squares.unflatten(2, (-1, 4 * views.shape[2]))) + self.marks[keep]

    def all_tokens(self, views: UInt8[Tensor, "B V C H W"]) -> Float[Tensor, "B V T W"]:
        """Nothing hidden: the tokens of every view."""
        tokens = self._read(squares_of(views, self.config.patch)) + self.marks
        return tokens.unflatten(1, (views.shape[1], -1))

    def _read(self, squares: Shaped[Tensor, "B K P S"]) -> Float[Tensor, "B K W"]:
        """Patches through the stem, which reads pixels from -0.5 to 0.5. Its first weights are
        scaled instead of them: there are thousands of times more pixels."""
        first = self.stem[0]
        assert isinstance(first, nn.Linear)
        bias = first.bias - first.weight.sum(1) / 2
        return self.stem[1:](F.linear(squares.to(first.weight.dtype), first.weight / 255, bias))

    def features(self, tokens: Float[Tensor, "B K W"]) -> Float[Tensor, "B K W"]:
        """The encoder's output: tokens that have all seen each other."""
        return self.norm(self.encoder(tokens))

    def draw(self, features: Float[Tensor, "B K W"], keep: Int[Tensor, "B K"]) -> Drawn:
        """Every view's picture, and the reward, from what was kept."""
        batch = len(features)
        width = self.config.width
        marks = self.hidden + self.marks  # (M, W)
        everything = marks.expand(batch, -1, -1).to(features.dtype)  # (B, M, W)
        where = keep[..., None].expand(-1, -1, width)  # (B, K, W)
        seen = features + marks.to(features.dtype)[keep]
        everything = everything.scatter(1, where, seen)
        patches = self.pixels(self.draw_norm(self.decoder(everything))).float()  # (B, M, 3 patch^2)
        difference = pictures_of(patches.unflatten(1, (len(self.mean), -1)), self.config.patch)
        reward = self.reward(features.mean(1)).squeeze(-1).float()
        return Drawn(self.mean + difference, reward)

    def forward(self, views: UInt8[Tensor, "B V C H W"], keep: Int[Tensor, "B K"]) -> Drawn:
        """Draws all views from the tokens ``keep`` alone."""
        return self.draw(self.features(self.tokens(views, keep)), keep)


class TokenReader(nn.Module):
    """Learned questions to tokens: attention whose queries are parameters.

    However many tokens there are, as many numbers come out, so any set of views can be read:
    K tokens of 128 numbers --8 questions, 4 heads--> 8 x 128 = 1024 numbers.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.questions = nn.Parameter(torch.randn(QUESTIONS, width))
        self.key = nn.Linear(width, width)
        self.value = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, K, W) -> (B, 8 W)."""
        query = self.questions.to(tokens.dtype).expand(len(tokens), -1, -1)  # (B, 8, W)
        query, key, value = map(split_heads, (query, self.key(tokens), self.value(tokens)))
        return F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(1)


def layer(width: int, heads: int) -> nn.TransformerEncoderLayer:
    """One layer of a transformer, (B, K, W) -> (B, K, W)."""
    return nn.TransformerEncoderLayer(
        width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True
    )


def _layers(config: AutoencoderConfig, count: int) -> nn.TransformerEncoder:
    one = layer(config.width, config.heads)
    return nn.TransformerEncoder(one, count, enable_nested_tensor=False)


def _taken(tokens: Tensor, keep: Tensor) -> Tensor:
    return tokens.gather(1, keep[..., None].expand(-1, -1, tokens.shape[-1]))


# --- Which tokens are kept ----------------------------------------------------------------------


def whole_views(mask: Bool[Tensor, " V"], tokens: int, batch: int = 1) -> Int[Tensor, "B K"]:
    """All ``tokens`` of each view in ``mask``, for every sample."""
    kept = mask.repeat_interleave(tokens).nonzero().flatten()
    return kept.expand(batch, -1)


def drawn_tokens(
    generator: torch.Generator, batch: int, views: int, tokens: int, view_masking: bool = True
) -> Int[Tensor, "B K"]:
    """Tokens to keep in a training batch: of one to all views, the same number for every sample,
    other views for each; in a third of the batches all of their tokens, else a share of them that
    is uniform between ``LEAST_KEPT`` and 1. Of all views, if there is no ``view_masking``. A
    function of ``generator`` alone.
    """
    least = 1 if view_masking else views
    visible = int(torch.randint(least, views + 1, (), generator=generator))
    share = float(torch.rand((), generator=generator)) * 1.5
    share = 1.0 if share >= 1 else LEAST_KEPT + share * (1 - LEAST_KEPT)
    count = max(1, round(share * visible * tokens))
    order = torch.rand(batch, views, generator=generator).argsort(1).argsort(1)  # Ranks, (B, V).
    score = torch.rand(batch, views, tokens, generator=generator)
    score[order >= visible] = 2.0  # Hidden views: larger than any score of a visible one.
    return score.flatten(1).argsort(1)[:, :count].sort(1).values


# --- Losses -------------------------------------------------------------------------------------


def autoencoder_loss(
    model: MultiViewAutoencoder,
    views: UInt8[Tensor, "B V C H W"],
    reward: Float[Tensor, " B"],
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """The loss on a batch of stacks, with tokens kept that ``generator`` draws."""
    batch, count = views.shape[:2]
    masking = model.config.view_masking
    keep = drawn_tokens(generator, batch, count, model.tokens_of_a_view, masking).to(views.device)
    drawn = model(views, keep)
    pictures = newest(views)
    moves = moving(pictures, model.mean)
    loss = reconstruction_loss(drawn.pictures, pictures, moves, model.config.moving_weight)
    return loss + REWARD_WEIGHT * F.mse_loss(drawn.reward, symlog(reward))


def newest(views: UInt8[Tensor, "B V C H W"]) -> Float[Tensor, "B V 3 H W"]:
    """The last frame of stacks, from 0 to 1."""
    return views[:, :, -3:].float() / 255


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
    """Squared error: of each view a mean over pixels in which those that move count 1 +
    ``moving_weight``, and of these the mean. A camera on the hand, whose whole picture moves,
    counts no more than one in which a few pixels do."""
    weight = 1 + moving_weight * moves.to(drawn.dtype)
    error = (drawn - pictures).square().mean(2)  # (B, V, H, W)
    return ((weight * error).sum((0, 2, 3)) / weight.sum((0, 2, 3))).mean()


def symlog(x: Tensor) -> Tensor:
    """sign(x) log(1 + |x|): rewards of any size in a range that a network can give."""
    return x.sign() * x.abs().log1p()


# --- Patches ------------------------------------------------------------------------------------


def positions(side: int, width: int) -> Float[Tensor, "T W"]:
    """Fixed marks of ``side`` x ``side`` places: sines and cosines of row and of column, a quarter
    of ``width`` each, with wave lengths from 2 pi to 20,000 pi."""
    quarter = width // 4
    rates = 10_000 ** (-torch.arange(quarter) / quarter)
    row, column = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    angles = [place.flatten()[:, None] * rates for place in (row, column)]
    return torch.cat([wave(angle) for angle in angles for wave in (torch.sin, torch.cos)], 1)


def squares_of(views: Shaped[Tensor, "B V C H W"], patch: int) -> Shaped[Tensor, "B M P S"]:
    """Cuts every view into patches, row by row, and each of them into P squares of 2 x 2 pixels,
    whose S numbers are 4 of every channel. Saliency asks for gradients, so views may be floats."""
    batch, count, channels, size, _ = views.shape
    side = size // patch
    half = patch // 2
    whole = views.dtype == torch.uint8
    # Two bytes that are neighbours in a row are moved together, which is faster.
    pixels = views.contiguous().view(torch.int16) if whole else views
    cut = pixels.reshape(batch, count, channels, side, half, 2, side, half, -1)
    cut = cut.permute(0, 1, 3, 6, 4, 7, 2, 5, 8)  # By view, patch and square; channels inside.
    squares = cut.reshape(batch, count * side**2, half**2, -1)  # (B, M, P, S)
    return squares.view(torch.uint8) if whole else squares


def pictures_of(patches: Float[Tensor, "B V T P"], patch: int) -> Float[Tensor, "B V 3 H W"]:
    """Puts T patches of 3 x ``patch`` x ``patch`` numbers into their places, row by row."""
    batch, views, tokens, _ = patches.shape
    side = round(tokens**0.5)
    grid = patches.reshape(batch, views, side, side, 3, patch, patch)
    # (B, V, 3, patch row, row in patch, patch column, column in patch)
    return grid.permute(0, 1, 4, 2, 5, 3, 6).reshape(batch, views, 3, side * patch, side * patch)
