"""MV-MAE: the streams that are present are tokens of a masked autoencoder (Seo et al., 2023).

The autoencoder (``agent/autoencoder.py``) learns to draw all views from some of their patches. Here
its tokens are what a policy acts on. The patches of the present streams, and no others, go
through its encoder, and a few learned questions are asked to what comes out:

    (B, V, C, H, W) --stem--> V x 36 tokens; of a subset: the tokens of its streams
    K tokens --encoder--> K x 128 --8 questions, 4 heads--> 1024 numbers --> actor, critic

Three cameras: K = 108; one alone: K = 36. An absent stream has no tokens, so any subset but the
empty one can be acted on.

The autoencoder learns from pictures alone and the questions from the actor's loss, unless
``end_to_end``: then the actor's loss reaches the autoencoder, too.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from madviz.agent.autoencoder import MultiViewAutoencoder, autoencoder_loss, whole_views
from madviz.agent.merges.base import Heads, MergeFunctions, Noise, Streams, wide_heads
from madviz.agent.networks import NetworkConfig
from madviz.agent.sizes import PICTURE
from madviz.agent.token_reader import QUESTIONS as QUESTIONS
from madviz.agent.token_reader import TokenReader


class TokenNetworks(nn.Module):
    """The autoencoder, and who asks it."""

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        super().__init__()
        mean = torch.zeros(len(streams), 3, PICTURE, PICTURE)
        self.autoencoder = MultiViewAutoencoder(config.autoencoder, 3 * config.frame_stack, mean)
        self.reader = TokenReader(config.autoencoder.width)
        self.end_to_end = config.end_to_end

    def _has_gradients(self) -> bool:
        """The actor's loss stops here in training; saliency asks a trained network."""
        return (self.end_to_end or not self.training) and torch.is_grad_enabled()

    def tokens(self, views: Tensor) -> Tensor:
        """(B, V, C, H, W) uint8 -> (B, V, T, W): of every stream, each from its own patch."""
        batch, count = views.shape[:2]
        every = torch.ones(count, dtype=torch.bool, device=views.device)
        keep = whole_views(every, self.autoencoder.tokens_of_a_view, batch)
        with torch.set_grad_enabled(self._has_gradients()):
            return self.autoencoder.tokens(views, keep).unflatten(1, (count, -1))

    def features(self, tokens: Tensor) -> Tensor:
        """(B, K, W) -> (B, K, W): the tokens of a subset, having seen each other."""
        with torch.set_grad_enabled(self._has_gradients()):
            return self.autoencoder.features(tokens)


def _present(tokens: Tensor, mask: Tensor) -> Tensor:
    """(B, V, T, W), (V,) -> (B, K, W): the tokens of the streams in a subset."""
    return tokens[:, mask.bool()].flatten(1, 2)


class MvMae(MergeFunctions):
    own_optimiser = "reconstruction"
    reconstructs = True

    def networks(self, config: NetworkConfig, streams: Streams) -> TokenNetworks:
        return TokenNetworks(config, streams)

    def heads(self, config: NetworkConfig, streams: Streams) -> Heads:
        return wide_heads(config, QUESTIONS * config.autoencoder.width)

    def encode(self, net: TokenNetworks, views: Tensor) -> Tensor:
        return net.tokens(views)

    def rows(self, net: TokenNetworks, features: Tensor, masks: Tensor, noise: Noise) -> Tensor:
        """Subsets of as many streams go through the networks together."""
        rows: dict[int, Tensor] = {}
        for size in masks.sum(1).unique():
            which = (masks.sum(1) == size).nonzero().flatten().tolist()
            tokens = torch.stack([_present(features, masks[n]) for n in which])
            read = net.reader(net.features(tokens.flatten(0, 1)))
            rows.update(zip(which, read.unflatten(0, tokens.shape[:2]), strict=True))
        return torch.stack([rows[n] for n in range(len(masks))])

    def look_at(self, net: TokenNetworks, mean: Callable[[], Tensor]) -> None:
        net.autoencoder.mean.copy_(mean())

    def reconstruction_loss(
        self, net: TokenNetworks, views: Tensor, reward: Tensor, generator: torch.Generator
    ) -> Tensor:
        return autoencoder_loss(net.autoencoder, views, reward, generator)

    def imagined(self, net: TokenNetworks, features: Tensor, mask: Tensor) -> Tensor:
        model = net.autoencoder
        keep = whole_views(mask.bool(), model.tokens_of_a_view, len(features))
        return model.draw(net.features(_present(features, mask)), keep).pictures.clamp(0, 1)

    def mean_pictures(self, net: TokenNetworks) -> Tensor:
        return net.autoencoder.mean

    def feature_of_each(self, net: TokenNetworks, features: Tensor, streams: Streams) -> Tensor:
        """Every stream's own tokens, before they have seen others: (B, V, 36 x 128)."""
        return features.flatten(2)


FUNCTIONS = MvMae()
