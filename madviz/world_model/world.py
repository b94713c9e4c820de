"""MV-MWM's world model: a belief over the tokens of a masked autoencoder (Seo et al., 2023).

A masked autoencoder over views (``autoencoder.py``) learns to draw all views from some patches. The
world model takes its tokens as data: no gradient reaches the autoencoder from here. It reads the
tokens of the views that are present, and predicts those of *all* views:

    a window of 3 + 4 frames, its actions; of every sample only some views are present
    tokens --reader--> 7 embeddings --RSSM--> belief at the 3rd frame, rebuilt from nothing
                                              and 4 more, with the known actions between them
    each of these 5 beliefs predicts: all views' features, the state;
    each of the last 4 also: the reward (symlog) that led there, and whether anything follows

The first three frames are the policy's frame stack. A policy keeps nothing between decisions, so it
rebuilds its belief over its stack at each of them; what happened between these frames is unknown to
it, and therefore here. The present views are drawn uniformly: of three cameras 1, 2 or 3.

A guess is only good for the next decision if nothing else is asked of it: what was believed of a
target is lost within a few imagined decisions. So the beliefs guessed from the first one on,
without any further picture, must predict all that, too (*ahead*; not in the paper).

The losses are negative logarithms of likelihoods, as in the paper: squared errors, halved, and
summed over what is predicted; of the features the mean over tokens is taken. An error of 0.1 in
each of a token's 64 numbers costs 0.5 x 64 x 0.01 = 0.32, and one of 0.1 in the reward's symlog
0.005, times ``REWARD``: 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.merges.attention import HEADS
from madviz.agent.sizes import NetworkConfig
from madviz.world_model.autoencoder import QUESTIONS, TokenReader, layer, symlog
from madviz.world_model.rssm import Belief, Rssm, balanced_kl, joined, mlp
from madviz.world_model.sizes import MvMwmOptions

BALANCE = 0.8
FREE = 0.1
"""Share of the KL that moves the prior, and nats that cost nothing: the paper's."""
FEATURES = 1.0
REWARD = 100.0
STATE = 10.0
"""Weights of the errors in features, in the reward's symlog and in the state's. At equal weights
the features, which are thousands of numbers, leave little to the reward, which is one: after 200
updates on toy/reach 0.70 of its variance was predicted with these, and 0.02 with 4 and 10."""


@dataclass(frozen=True)
class Window:
    """A batch for the world model: T frames of B samples, of which the last L have known
    actions before them."""

    present: Float[Tensor, "T B E"]
    """Embeddings of the views that are present."""
    features: Float[Tensor, "L+1 B M W"]
    """The autoencoder's tokens of all views, at the last L + 1 frames: data."""
    state: Float[Tensor, "L+1 B S"]
    action: Float[Tensor, "L B A"]
    reward: Float[Tensor, "L B"]
    """For these actions."""
    follows: Float[Tensor, "L B"]
    """1 where anything follows, 0 where nothing does."""


class WorldModel(nn.Module):
    """See the module."""

    def __init__(self, config: NetworkConfig, options: MvMwmOptions, tokens: int) -> None:
        """For an autoencoder of ``tokens`` tokens, those of all views."""
        super().__init__()
        sizes = options.world_model
        width = options.autoencoder.width
        self.shape = (tokens, width)
        self.narrow = nn.Linear(width, sizes.reader_width)
        layers = [layer(sizes.reader_width, HEADS) for _ in range(sizes.reader_layers)]
        self.layers = nn.Sequential(*layers)
        self.reader = TokenReader(sizes.reader_width)
        self.rssm = Rssm(sizes, QUESTIONS * sizes.reader_width, config.action_dim)
        belief = sizes.feature
        hidden = sizes.hidden
        self.features = mlp(belief, hidden, 1, tokens * width)
        self.reward = mlp(belief, hidden, 1, 1)
        self.follows = mlp(belief, hidden, 1, 1)
        self.state = mlp(belief, hidden, 1, config.state_dim)

    def embed(self, tokens: Float[Tensor, "B K W"]) -> Float[Tensor, "B E"]:
        """Reads the tokens that are present, whichever they are."""
        return self.reader(self.layers(self.narrow(tokens)))

    def predicted_features(self, belief: Float[Tensor, "B Z"]) -> Float[Tensor, "B M W"]:
        """Tokens of all views."""
        return self.features(belief).unflatten(1, self.shape)

    def predicted_state(self, belief: Float[Tensor, "B Z"]) -> Float[Tensor, "B S"]:
        """Proprioception."""
        return symexp(self.state(belief))

    def predicted_reward(self, belief: Float[Tensor, "B Z"]) -> Float[Tensor, " B"]:
        """The reward of the decision that led there."""
        return symexp(self.reward(belief).squeeze(1))

    def predicted_follows(self, belief: Float[Tensor, "B Z"]) -> Float[Tensor, " B"]:
        """How likely it is that anything follows."""
        return self.follows(belief).squeeze(1).sigmoid()

    def observe(
        self, window: Window, noise: Float[Tensor, "T B G"]
    ) -> tuple[list[Belief], list[Belief]]:
        """L + 1 posteriors, the first of them rebuilt over the stack, and L priors."""
        stack = len(window.present) - len(window.action)
        posteriors = [self.rssm.observe(window.present[:stack], noise[:stack])]
        priors = []
        for step, action in enumerate(window.action):
            deterministic = self.rssm.advance(posteriors[-1], action)
            priors.append(self.rssm.prior_belief(deterministic, None))
            embedding = window.present[stack + step]
            drawn = noise[stack + step]
            posteriors.append(self.rssm.posterior_belief(deterministic, embedding, drawn))
        return posteriors, priors

    def go_on(
        self, belief: Belief, action: Float[Tensor, "L B A"], noise: Float[Tensor, "L B G"]
    ) -> list[Belief]:
        """L priors in a row: what is guessed of the decisions ``action`` without a picture."""
        guessed = []
        for done, drawn in zip(action, noise, strict=True):
            belief = self.rssm.prior_belief(self.rssm.advance(belief, done), drawn)
            guessed.append(belief)
        return guessed


def world_model_losses(
    model: WorldModel, window: Window, noise: Float[Tensor, "T+L B G"], kl_weight: float
) -> dict[str, Float[Tensor, ""]]:
    """The terms that the world model minimises the sum of, by name; ``noise`` draws the beliefs,
    and those that are guessed without pictures after them.

    Raises ValueError for a window without actions.
    """
    frames = len(window.present)
    if not len(window.action):
        raise ValueError("expected a window with actions, found none")
    posteriors, priors = model.observe(window, noise[:frames])
    kl = balanced_kl(joined(posteriors[1:]).logits, joined(priors).logits, BALANCE, FREE)
    seen = sight_losses(model, joined(posteriors), window.features, window.state)
    seen |= outcome_losses(model, joined(posteriors[1:]), window.reward, window.follows)
    guesses = joined(model.go_on(posteriors[0], window.action, noise[frames:]))
    guessed = sight_losses(model, guesses, window.features[1:], window.state[1:])
    guessed |= outcome_losses(model, guesses, window.reward, window.follows)
    ahead = torch.stack(list(guessed.values())).sum()
    return seen | {"ahead": ahead, "kl": kl_weight * kl}


def sight_losses(
    model: WorldModel,
    belief: Belief,
    features: Float[Tensor, "T B M W"],
    state: Float[Tensor, "T B S"],
) -> dict[str, Float[Tensor, ""]]:
    """Errors of T x B beliefs in what is seen and felt."""
    predicted = model.predicted_features(belief.feature)
    felt = symlog(state).flatten(0, 1)
    return {
        "features": FEATURES * feature_loss(predicted, features.flatten(0, 1)),
        "state": STATE * squared_error(model.state(belief.feature), felt),
    }


def outcome_losses(
    model: WorldModel, belief: Belief, reward: Float[Tensor, "L B"], follows: Float[Tensor, "L B"]
) -> dict[str, Float[Tensor, ""]]:
    """Errors of L x B beliefs in what the decisions before them brought."""
    likely = model.follows(belief.feature).squeeze(1)
    brought = symlog(reward).flatten()[:, None]
    return {
        "reward": REWARD * squared_error(model.reward(belief.feature), brought),
        "follows": F.binary_cross_entropy_with_logits(likely, follows.flatten()),
    }


def feature_loss(
    predicted: Float[Tensor, "B M W"], features: Float[Tensor, "B M W"]
) -> Float[Tensor, ""]:
    """Half the squared error, summed over a token's numbers; the mean over tokens and samples."""
    return 0.5 * (predicted - features).square().sum(2).mean()


def squared_error(
    predicted: Float[Tensor, "B N"], target: Float[Tensor, "B N"]
) -> Float[Tensor, ""]:
    """Half the squared error, summed over N numbers; the mean over samples."""
    return 0.5 * (predicted - target).square().sum(1).mean()


def symexp(x: Tensor) -> Tensor:
    """The other way round than ``symlog``."""
    return x.sign() * x.abs().expm1()
