"""MV-MWM: a world model's belief over tokens of the streams that are present (Seo et al., 2023).

Every frame of the stack is cut into tokens by itself. Of a subset, the tokens of its streams alone
go through the masked autoencoder and are read; the belief is rebuilt over the frames of the stack,
from nothing, once for each subset:

    (B, V, 3 frames, H, W) --stem--> 3 x V x 36 tokens; of a subset: those of its streams
    K tokens --autoencoder, questions--> an embedding a frame --RSSM, 3 times--> belief --> actor

So a policy keeps nothing between decisions, and absent pixels reach nothing. The belief is the
likeliest one, nothing is drawn. What is known of the world's course in training
(``agent/world_model.py``, ``agent/imagination.py``) is not used when acting.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from madviz.agent.autoencoder import MultiViewAutoencoder, autoencoder_loss, whole_views
from madviz.agent.imagination import BeliefActor, BeliefCritic
from madviz.agent.merges.base import Heads, MergeFunctions, Noise, Streams
from madviz.agent.networks import NetworkConfig
from madviz.agent.sizes import PICTURE
from madviz.agent.world_model import WorldModel


class WorldNetworks(nn.Module):
    """The autoencoder, and the world model that reads it."""

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        super().__init__()
        self.frames = config.frame_stack
        mean = torch.zeros(len(streams), 3, PICTURE, PICTURE)
        self.autoencoder = MultiViewAutoencoder(config.autoencoder, 3, mean)
        tokens = len(streams) * self.autoencoder.tokens_of_a_view
        self.world = WorldModel(config, tokens)

    def tokens(self, frames: Tensor) -> Tensor:
        """(B, V, 3, H, W) -> (B, V, P, W): P tokens a view, each from its own patch alone."""
        batch, count = frames.shape[:2]
        every = torch.ones(count, dtype=torch.bool, device=frames.device)
        keep = whole_views(every, self.autoencoder.tokens_of_a_view, batch)
        return self.autoencoder.tokens(frames, keep).unflatten(1, (count, -1))


class MvMwm(MergeFunctions):
    own_optimiser = "reconstruction"
    reconstructs = True

    def networks(self, config: NetworkConfig, streams: Streams) -> WorldNetworks:
        return WorldNetworks(config, streams)

    def heads(self, config: NetworkConfig, streams: Streams) -> Heads:
        return BeliefActor(config), BeliefCritic(config)

    def encode(self, net: WorldNetworks, views: Tensor) -> Tensor:
        """-> (B, V, F, P, W): the tokens of every frame of every stream."""
        frames = views.unflatten(2, (net.frames, 3)).transpose(1, 2)
        return net.tokens(frames.flatten(0, 1)).unflatten(0, frames.shape[:2]).transpose(1, 2)

    def rows(self, net: WorldNetworks, features: Tensor, masks: Tensor, noise: Noise) -> Tensor:
        """Subsets of as many streams go through the networks together."""
        rows: dict[int, Tensor] = {}
        for size in masks.sum(1).unique():
            which = (masks.sum(1) == size).nonzero().flatten().tolist()
            tokens = torch.stack([_present(features, masks[n]) for n in which])  # (N, F, B, K, W)
            seen = net.world.embed(net.autoencoder.features(tokens.flatten(0, 2)))
            frames = seen.unflatten(0, tokens.shape[:3]).transpose(0, 1)
            belief = net.world.rssm.observe(frames.flatten(1, 2), None)
            rows.update(zip(which, belief.feature.unflatten(0, (len(which), -1)), strict=True))
        return torch.stack([rows[n] for n in range(len(masks))])

    def look_at(self, net: WorldNetworks, mean: Callable[[], Tensor]) -> None:
        net.autoencoder.mean.copy_(mean())

    def reconstruction_loss(
        self, net: WorldNetworks, views: Tensor, reward: Tensor, generator: torch.Generator
    ) -> Tensor:
        return autoencoder_loss(net.autoencoder, views[:, :, -3:], reward, generator)

    def imagined(self, net: WorldNetworks, features: Tensor, mask: Tensor) -> Tensor:
        model = net.autoencoder
        keep = whole_views(mask.bool(), model.tokens_of_a_view, len(features))
        newest = _present(features, mask)[-1]
        return model.draw(model.features(newest), keep).pictures.clamp(0, 1)

    def mean_pictures(self, net: WorldNetworks) -> Tensor:
        return net.autoencoder.mean

    def feature_of_each(self, net: WorldNetworks, features: Tensor, streams: Streams) -> Tensor:
        """Every stream's own tokens of the newest frame, before they have seen others."""
        return features[:, :, -1].flatten(2)


def _present(features: Tensor, mask: Tensor) -> Tensor:
    """(B, V, F, P, W), (V,) -> (F, B, K, W): the tokens of the streams in a subset, by frame."""
    return features[:, mask.bool()].permute(2, 0, 1, 3, 4).flatten(2, 3)


FUNCTIONS = MvMwm()
