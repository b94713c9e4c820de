"""MV-MWM: a world model's belief over tokens of the streams that are present (Seo et al., 2023).

Every frame of the stack is cut into tokens by itself. Of a subset, the tokens of its streams alone
go through the masked autoencoder and are read; the belief is rebuilt over the frames of the stack,
from nothing, once for each subset:

    (B, V, 3 frames, H, W) --stem--> 3 x V x 36 tokens; of a subset: those of its streams
    K tokens --autoencoder, questions--> an embedding a frame --RSSM, 3 times--> belief --> actor

So a policy keeps nothing between decisions, and absent pixels reach nothing. The belief is the
likeliest one, nothing is drawn. What is known of the world's course in training
(``world.py``, ``actor_critic.py``) is not used when acting.
"""

from __future__ import annotations

import torch
from torch import Tensor

from madviz.agent.merges.base import Heads, Streams
from madviz.agent.networks import ActorHead, NetworkConfig
from madviz.world_model.actor_critic import BeliefActor, BeliefCritic, likeliest
from madviz.world_model.autoencoder import whole_views
from madviz.world_model.mv_mae import DrawingMerge
from madviz.world_model.rssm import Belief
from madviz.world_model.sizes import MvMwmOptions
from madviz.world_model.world import WorldModel


class WorldNetworks(DrawingMerge):
    """MV-MWM: the autoencoder, and the world model that reads it."""

    foresees = True

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        options = config.own_as(MvMwmOptions)
        super().__init__(config, streams, options.autoencoder, frames=1)
        self.frames = config.frame_stack
        tokens = len(streams) * self.autoencoder.tokens_of_a_view
        self.world = WorldModel(config, options, tokens)

    def heads(self, config: NetworkConfig) -> Heads:
        sizes = config.own_as(MvMwmOptions).world_model
        return BeliefActor(config, sizes), BeliefCritic(config, sizes)

    def encode(self, views: Tensor) -> Tensor:
        """-> (B, V, F, T, W): the tokens of every frame of every stream."""
        frames = views.unflatten(2, (self.frames, 3)).transpose(1, 2)  # (B, F, V, 3, H, W)
        tokens = self.autoencoder.all_tokens(frames.flatten(0, 1))  # (B * F, V, T, W)
        return tokens.unflatten(0, frames.shape[:2]).transpose(1, 2)

    def present(self, features: Tensor, mask: Tensor) -> Tensor:
        """(F, B, K, W): by frame."""
        return features[:, mask].permute(2, 0, 1, 3, 4).flatten(2, 3)

    def read(self, tokens: Tensor) -> Tensor:
        return self.belief(tokens).feature.unflatten(0, (len(tokens), -1))  # (N, B, Z)

    def belief(self, tokens: Tensor) -> Belief:
        """(N, F, B, K, W) -> the belief of N x B samples, rebuilt over the frames from nothing."""
        embedded = self.world.embed(self.autoencoder.features(tokens.flatten(0, 2)))
        frames = embedded.unflatten(0, tokens.shape[:3]).transpose(0, 1)  # (F, N, B, E)
        return self.world.rssm.observe(frames.flatten(1, 2), None)

    def seen(self, features: Tensor, mask: Tensor) -> Tensor:
        return self.autoencoder.features(self.present(features, mask)[-1])

    def foreseen(
        self, actor: ActorHead, features: Tensor, mask: Tensor, state: Tensor, decisions: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Pictures are drawn from the tokens that the beliefs predict of all views."""
        world = self.world
        model = self.autoencoder
        belief = self.belief(self.present(features, mask.bool())[None])
        beliefs, action = likeliest(world, actor, belief, state, decisions)
        later = beliefs.flatten(0, 1)  # (T * B, Z)
        every = whole_views(torch.ones_like(mask, dtype=torch.bool), model.tokens_of_a_view)
        tokens = world.predicted_features(later)  # (T * B, M, W)
        drawn = model.draw(tokens, every.expand(len(tokens), -1)).pictures.clamp(0, 1)
        reward = world.predicted_reward(later)
        shape = beliefs.shape[:2]
        return drawn.unflatten(0, shape), reward.view(shape), action

    def feature_of_each(self, features: Tensor) -> Tensor:
        """Every stream's own tokens of the newest frame, before they have seen others."""
        return features[:, :, -1].flatten(2)  # (B, V, T * W)
