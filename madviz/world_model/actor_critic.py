"""MV-MWM's actor and critic, and what they learn from: decisions that a world model imagines.

The problem: a simulator with cameras is slow, and has no gradient. The idea (Hafner et al., 2020):
go on from a belief with the world model alone, for some decisions, and follow the gradient of what
they bring through it (*dynamics gradients*):

    belief --actor--> action --RSSM, prior--> belief --actor--> ...            H = 15 decisions
                                |- reward, and whether anything follows, of each

What a decision brings is its lambda-return: the reward and, from then on, a mixture of what the
critic expects and what was imagined further:

    G_k = r_k + d_k ((1 - lambda) V_k + lambda G_k+1),     G_H-1 = r_H-1 + d_H-1 V_H-1

With lambda 0.95, rewards of 1, discounts of 0.9 and V = 5 everywhere, two decisions have G_1 = 1 +
0.9 x 5 = 5.5 and G_0 = 1 + 0.9 (0.05 x 5 + 0.95 x 5.5) = 5.9275.

The critic judges beliefs, not actions: what it gives as Q is the value of acting on as the actor
does. Its targets come from a slow copy of itself. Actions are drawn from a normal distribution cut
off at -1 and 1, whose entropy is part of what the actor maximises. Both heads also read the
proprioceptive state; in imagination it is the one that the world model predicts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from madviz.agent.networks import ActorHead, CriticHead, NetworkConfig, read_state
from madviz.world_model.rssm import Belief, mlp
from madviz.world_model.sizes import WorldModelConfig
from madviz.world_model.world import WorldModel

LEAST_STD = 0.1
"""Least standard deviation of an action, before the distribution is cut off."""
_EDGE = 1e-6
"""How near to 0 and 1 a probability may come whose quantile is taken."""


class BeliefActor(ActorHead):
    """Belief and state to a truncated normal over actions."""

    def __init__(self, config: NetworkConfig, sizes: WorldModelConfig) -> None:
        super().__init__()
        self.config = config
        self.mlp = _head(config, sizes, 2 * config.action_dim)

    def forward(self, feature: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """(..., Z), (..., S) -> (..., A) each: the middle before tanh, and the log of the standard
        deviation, which is from ``LEAST_STD`` to 2.1."""
        middle, raw = self.mlp(_inputs(self.config, feature, state)).chunk(2, -1)
        return middle, (2 * torch.sigmoid(raw / 2) + LEAST_STD).log()


class BeliefCritic(CriticHead):
    """Belief and state to their value; it does not look at the action."""

    def __init__(self, config: NetworkConfig, sizes: WorldModelConfig) -> None:
        super().__init__()
        self.config = config
        self.mlp = _head(config, sizes, 1)
        nn.init.zeros_(self.mlp[-1].weight)  # type: ignore[arg-type]

    def value(self, feature: Tensor, state: Tensor) -> Tensor:
        """(..., Z), (..., S) -> (...,): the discounted rewards that are expected."""
        return self.mlp(_inputs(self.config, feature, state)).squeeze(-1)

    def forward(self, feature: Tensor, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        value = self.value(feature, state)
        return value, value


def _head(config: NetworkConfig, sizes: WorldModelConfig, outputs: int) -> nn.Sequential:
    """From belief and state, side by side, to ``outputs`` numbers."""
    inputs = sizes.feature + config.state_inputs
    return mlp(inputs, config.hidden_dim, sizes.head_layers, outputs)


def _inputs(config: NetworkConfig, feature: Tensor, state: Tensor) -> Tensor:
    return torch.cat([feature, read_state(config, state)], -1)


# --- Actions ------------------------------------------------------------------------------------


def truncated_normal(
    middle: Float[Tensor, "... A"], std: Float[Tensor, "... A"], noise: Float[Tensor, "... A"]
) -> tuple[Float[Tensor, "... A"], Tensor]:
    """Actions drawn by ``noise``, uniform in [0, 1), from normal distributions cut off at -1 and 1,
    and (...,) the distributions' entropy in nats, summed over A. Gradients go through both.

    With a = (-1 - middle) / std, b = (1 - middle) / std and Z = Phi(b) - Phi(a), an action is
    middle + std Phi^-1(Phi(a) + noise Z), and its entropy
    log(sqrt(2 pi e) std Z) + (a phi(a) - b phi(b)) / (2 Z).
    """
    low = (-1 - middle) / std
    high = (1 - middle) / std
    below = _phi(low)
    inside = _phi(high) - _phi(low)
    quantile = (below + noise * inside).clamp(_EDGE, 1 - _EDGE)
    drawn = middle + std * math.sqrt(2) * torch.erfinv(2 * quantile - 1)
    edges = (low * _density(low) - high * _density(high)) / (2 * inside)
    entropy = 0.5 * math.log(2 * math.pi * math.e) + std.log() + inside.log() + edges
    return drawn.clamp(-1, 1), entropy.sum(-1)


def _phi(x: Tensor) -> Tensor:
    return 0.5 * (1 + torch.erf(x / math.sqrt(2)))


def _density(x: Tensor) -> Tensor:
    return torch.exp(-0.5 * x.square()) / math.sqrt(2 * math.pi)


def act(actor: ActorHead, feature: Tensor, state: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """(..., Z), (..., S), (..., A) uniform -> drawn actions (..., A), and entropies (...,)."""
    middle, log_std = actor(feature, state)
    return truncated_normal(torch.tanh(middle), log_std.exp(), noise)


# --- Imagination --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Imagination:
    """H imagined decisions from each of B beliefs."""

    feature: Float[Tensor, "H+1 B Z"]
    """Beliefs before every decision, and the last one."""
    state: Float[Tensor, "H+1 B S"]
    entropy: Float[Tensor, "H B"]
    reward: Float[Tensor, "H B"]
    discount: Float[Tensor, "H B"]
    """Gamma times how likely it is that anything follows."""


def imagine(
    world: WorldModel,
    actor: ActorHead,
    belief: Belief,
    state: Float[Tensor, "B S"],
    noise: tuple[Float[Tensor, "H B A"], Float[Tensor, "H B G"]],
    gamma: float,
) -> Imagination:
    """Lets the actor go on from ``belief`` and ``state`` in the world model alone. The actor takes
    what it reads as data; gradients go from rewards through beliefs into actions. ``noise``,
    uniform in [0, 1), draws actions and beliefs."""
    features = [belief.feature]
    states = [state]
    entropies = []
    for drawn, latent in zip(*noise, strict=True):
        action, entropy = act(actor, features[-1].detach(), states[-1].detach(), drawn)
        belief = world.rssm.prior_belief(world.rssm.advance(belief, action), latent)
        features.append(belief.feature)
        states.append(world.predicted_state(belief.feature))
        entropies.append(entropy)
    later = torch.cat(features[1:])  # (H * B, Z)
    shape = noise[0].shape[:2]
    reward = world.predicted_reward(later).view(shape)
    discount = gamma * world.predicted_follows(later).view(shape)
    return Imagination(
        torch.stack(features), torch.stack(states), torch.stack(entropies), reward, discount
    )


def likeliest(
    world: WorldModel,
    actor: ActorHead,
    belief: Belief,
    state: Float[Tensor, "B S"],
    decisions: int,
) -> tuple[Float[Tensor, "T B Z"], Float[Tensor, "T B A"]]:
    """T ``decisions``, as the belief after each, and the actions. Nothing is drawn: the actor's
    likeliest action, the likeliest belief after it, and so on."""
    features = []
    actions = []
    for _ in range(decisions):
        actions.append(torch.tanh(actor(belief.feature, state)[0]))
        belief = world.rssm.prior_belief(world.rssm.advance(belief, actions[-1]), None)
        features.append(belief.feature)
        state = world.predicted_state(belief.feature)
    return torch.stack(features), torch.stack(actions)


def lambda_returns(
    reward: Float[Tensor, "H B"],
    discount: Float[Tensor, "H B"],
    value: Float[Tensor, "H B"],
    mixture: float,
) -> Float[Tensor, "H B"]:
    """G of every decision; ``value`` is that of where it led, ``mixture`` is lambda."""
    returns = []
    following = value[-1]
    for r, d, v in zip(reward.flip(0), discount.flip(0), value.flip(0), strict=True):
        following = r + d * ((1 - mixture) * v + mixture * following)
        returns.append(following)
    return torch.stack(returns[::-1])


def reached(discount: Float[Tensor, "H B"]) -> Float[Tensor, "H B"]:
    """The weight of each decision: 1 for the first, then the product of the discounts before it."""
    ones = torch.ones_like(discount[:1])
    return torch.cat([ones, discount[:-1]]).cumprod(0).detach()


def imagined_actor_loss(
    returns: Float[Tensor, "H B"],
    entropy: Float[Tensor, "H B"],
    weight: Float[Tensor, "H B"],
    entropy_weight: float,
) -> Float[Tensor, ""]:
    """Returns and entropy are maximised."""
    return -(weight * (returns + entropy_weight * entropy)).mean()


def imagined_critic_loss(
    value: Float[Tensor, "H B"], returns: Float[Tensor, "H B"], weight: Float[Tensor, "H B"]
) -> Float[Tensor, ""]:
    """Half the squared error of what was expected before every decision."""
    return 0.5 * (weight * (value - returns.detach()).square()).mean()
