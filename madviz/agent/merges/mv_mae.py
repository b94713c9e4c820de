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

import torch
from torch import Tensor, nn

from madviz.agent.autoencoder import MultiViewAutoencoder
from madviz.agent.merges.base import Heads, Streams, wide_heads
from madviz.agent.merges.drawing import DrawingMerge
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
        with torch.set_grad_enabled(self._has_gradients()):
            return self.autoencoder.all_tokens(views)

    def features(self, tokens: Tensor) -> Tensor:
        """(B, K, W) -> (B, K, W): the tokens of a subset, having seen each other."""
        with torch.set_grad_enabled(self._has_gradients()):
            return self.autoencoder.features(tokens)


class MvMae(DrawingMerge):
    def networks(self, config: NetworkConfig, streams: Streams) -> TokenNetworks:
        return TokenNetworks(config, streams)

    def heads(self, config: NetworkConfig, streams: Streams) -> Heads:
        return wide_heads(config, QUESTIONS * config.autoencoder.width)

    def encode(self, net: TokenNetworks, views: Tensor) -> Tensor:
        return net.tokens(views)

    def present(self, features: Tensor, mask: Tensor) -> Tensor:
        return features[:, mask].flatten(1, 2)

    def read(self, net: TokenNetworks, tokens: Tensor) -> Tensor:
        rows = net.reader(net.features(tokens.flatten(0, 1)))
        return rows.unflatten(0, tokens.shape[:2])

    def seen(self, net: TokenNetworks, features: Tensor, mask: Tensor) -> Tensor:
        return net.features(self.present(features, mask))

    def feature_of_each(self, net: TokenNetworks, features: Tensor, streams: Streams) -> Tensor:
        """Every stream's own tokens, before they have seen others: (B, V, 36 x 128)."""
        return features.flatten(2)


FUNCTIONS = MvMae()
