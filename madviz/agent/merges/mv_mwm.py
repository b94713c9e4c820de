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

import torch
from torch import Tensor, nn

from madviz.agent.autoencoder import MultiViewAutoencoder, whole_views
from madviz.agent.imagination import BeliefActor, BeliefCritic, likeliest
from madviz.agent.merges.base import Heads, Streams
from madviz.agent.merges.drawing import ForeseeingMerge, Foreseen
from madviz.agent.networks import ActorHead, NetworkConfig
from madviz.agent.rssm import Belief
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


class MvMwm(ForeseeingMerge):
    def networks(self, config: NetworkConfig, streams: Streams) -> WorldNetworks:
        return WorldNetworks(config, streams)

    def heads(self, config: NetworkConfig, streams: Streams) -> Heads:
        return BeliefActor(config), BeliefCritic(config)

    def encode(self, net: WorldNetworks, views: Tensor) -> Tensor:
        """-> (B, V, F, T, W): the tokens of every frame of every stream."""
        frames = views.unflatten(2, (net.frames, 3)).transpose(1, 2)
        tokens = net.autoencoder.all_tokens(frames.flatten(0, 1))
        return tokens.unflatten(0, frames.shape[:2]).transpose(1, 2)

    def present(self, features: Tensor, mask: Tensor) -> Tensor:
        """(F, B, K, W): by frame."""
        return features[:, mask].permute(2, 0, 1, 3, 4).flatten(2, 3)

    def read(self, net: WorldNetworks, tokens: Tensor) -> Tensor:
        return self.belief(net, tokens).feature.unflatten(0, (len(tokens), -1))

    def belief(self, net: WorldNetworks, tokens: Tensor) -> Belief:
        """(N, F, B, K, W) -> of N x B samples, rebuilt over the frames from nothing."""
        embedded = net.world.embed(net.autoencoder.features(tokens.flatten(0, 2)))
        frames = embedded.unflatten(0, tokens.shape[:3]).transpose(0, 1)
        return net.world.rssm.observe(frames.flatten(1, 2), None)

    def seen(self, net: WorldNetworks, features: Tensor, mask: Tensor) -> Tensor:
        return net.autoencoder.features(self.present(features, mask)[-1])

    def foreseen(
        self,
        net: WorldNetworks,
        actor: ActorHead,
        features: Tensor,
        mask: Tensor,
        state: Tensor,
        decisions: int,
    ) -> Foreseen:
        """Pictures are drawn from the tokens that the beliefs predict of all views."""
        world, model = net.world, net.autoencoder
        belief = self.belief(net, self.present(features, mask.bool())[None])
        course = likeliest(world, actor, belief, state, decisions)
        later = course.feature.flatten(0, 1)
        every = whole_views(torch.ones_like(mask, dtype=torch.bool), model.tokens_of_a_view)
        tokens = world.predicted_features(later)
        drawn = model.draw(tokens, every.expand(len(tokens), -1)).pictures.clamp(0, 1)
        reward = world.predicted_reward(later)
        shape = course.feature.shape[:2]
        return Foreseen(drawn.unflatten(0, shape), reward.view(shape), course.action)

    def feature_of_each(self, net: WorldNetworks, features: Tensor, streams: Streams) -> Tensor:
        """Every stream's own tokens of the newest frame, before they have seen others."""
        return features[:, :, -1].flatten(2)


FUNCTIONS = MvMwm()
