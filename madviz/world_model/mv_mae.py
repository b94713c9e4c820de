"""MV-MAE: the streams that are present are tokens of a masked autoencoder (Seo et al., 2023).

The autoencoder (``autoencoder.py``) learns to draw all views from some of their patches. Here its
tokens are what a policy acts on. The patches of the present streams, and no others, go through its
encoder, and a few learned questions are asked to what comes out:

    (B, V, C, H, W) --stem--> V x 36 tokens; of a subset: the tokens of its streams
    K tokens --encoder--> K x 128 --8 questions, 4 heads--> 1024 numbers --> actor, critic
             '--> decoder --> every view

Three cameras: K = 108; one alone: K = 36. An absent stream has no tokens, so any subset but the
empty one can be acted on, and it can be asked what a missing camera would see.

The autoencoder learns from pictures alone and the questions from the actor's loss, unless
``end_to_end``: then the actor's loss reaches the autoencoder, too.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from madviz.agent.merges.base import Heads, Merge, Noise, Streams, wide_heads
from madviz.agent.networks import NetworkConfig
from madviz.agent.sizes import PICTURE
from madviz.world_model.autoencoder import (
    QUESTIONS,
    MultiViewAutoencoder,
    TokenReader,
    autoencoder_loss,
    newest,
    whole_views,
)
from madviz.world_model.sizes import AutoencoderConfig, MvMaeOptions


class DrawingMerge(Merge):
    """A merge over the tokens of a masked autoencoder, whose rows are subsets of the tokens."""

    own_optimiser = "reconstruction"
    draws = True

    def __init__(
        self, config: NetworkConfig, streams: Streams, sizes: AutoencoderConfig, frames: int
    ) -> None:
        """``frames`` of the stack are in one token."""
        super().__init__(config, streams)
        mean = torch.zeros(len(streams), 3, PICTURE, PICTURE)
        self.autoencoder = MultiViewAutoencoder(sizes, 3 * frames, mean)

    def present(self, features: Tensor, mask: Bool[Tensor, " V"]) -> Tensor:
        """Features -> (..., B, K, W): the tokens of the streams in ``mask``."""
        raise NotImplementedError

    def read(self, tokens: Tensor) -> Tensor:
        """(N, ..., B, K, W) tokens of N subsets of as many streams -> their rows (N, B, ...)."""
        raise NotImplementedError

    def seen(self, features: Tensor, mask: Tensor) -> Float[Tensor, "B K W"]:
        """The newest frame's tokens of a subset, each having seen the others."""
        raise NotImplementedError

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        """Subsets of as many streams go through the networks together."""
        rows: dict[int, Tensor] = {}
        for size in masks.sum(1).unique():
            which = (masks.sum(1) == size).nonzero().flatten().tolist()
            tokens = torch.stack([self.present(features, masks[n].bool()) for n in which])
            rows.update(zip(which, self.read(tokens), strict=True))
        return torch.stack([rows[n] for n in range(len(masks))])  # (N, B, ...)

    def set_mean(self, views: Tensor) -> None:
        self.autoencoder.mean.copy_(newest(views).mean(0))

    def mean_pictures(self) -> Tensor:
        return self.autoencoder.mean

    def reconstruction_loss(
        self, views: Tensor, reward: Tensor, generator: torch.Generator
    ) -> Tensor:
        frames = views[:, :, -self.autoencoder.channels :]  # (B, V, C, H, W)
        return autoencoder_loss(self.autoencoder, frames, reward, generator)

    def imagined(self, features: Tensor, mask: Tensor) -> Float[Tensor, "B V 3 H W"]:
        keep = whole_views(mask.bool(), self.autoencoder.tokens_of_a_view, len(features))  # (B, K)
        return self.autoencoder.draw(self.seen(features, mask.bool()), keep).pictures.clamp(0, 1)


class TokenNetworks(DrawingMerge):
    """MV-MAE: the autoencoder, and questions to its tokens."""

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        options = config.own_as(MvMaeOptions)
        super().__init__(config, streams, options.autoencoder, config.frame_stack)
        self.reader = TokenReader(options.autoencoder.width)
        self.end_to_end = options.end_to_end
        self.reconstructed = options.reconstructed

    def heads(self, config: NetworkConfig) -> Heads:
        return wide_heads(config, QUESTIONS * self.autoencoder.config.width)

    def encode(self, views: Tensor) -> Tensor:
        """(B, V, C, H, W) uint8 -> (B, V, T, W): every stream's tokens, each from its patch."""
        with torch.set_grad_enabled(self._has_gradients()):
            return self.autoencoder.all_tokens(views)

    def present(self, features: Tensor, mask: Tensor) -> Tensor:
        return features[:, mask].flatten(1, 2)  # (B, K, W)

    def read(self, tokens: Tensor) -> Tensor:
        rows = self.reader(self._having_seen(tokens.flatten(0, 1)))  # (N * B, 8 W)
        return rows.unflatten(0, tokens.shape[:2])

    def seen(self, features: Tensor, mask: Tensor) -> Tensor:
        return self._having_seen(self.present(features, mask))

    def feature_of_each(self, features: Tensor) -> Tensor:
        """Every stream's own tokens, before they have seen others: (B, V, 36 x 128)."""
        return features.flatten(2)

    def _having_seen(self, tokens: Float[Tensor, "B K W"]) -> Float[Tensor, "B K W"]:
        """The tokens of a subset, each having seen the others."""
        with torch.set_grad_enabled(self._has_gradients()):
            return self.autoencoder.features(tokens)

    def _has_gradients(self) -> bool:
        """The actor's loss stops here in training; saliency asks a trained network."""
        return (self.end_to_end or not self.training) and torch.is_grad_enabled()
