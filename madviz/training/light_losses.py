"""Losses of the light recipe: errors of actions (``light.py`` has the formula) and, where asked
for, of places, in the same way.

The problem of the second part: an action says little about where things are. Far from the ball, a
ball 2 cm further left changes hardly any action, so a camera whose picture has to be read finely is
taught slowly. The idea: while training, one more head reads what the actor's MLP reads and tells
where objects and goal are; its errors reach the trunk and the CNN. The policy is saved without it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.agent import Agent
from madviz.agent.networks import Actor, ActorHead
from madviz.errors import UserError
from madviz.types import Array, Environment, KnowsPlaces

SMALLEST_SPREAD = 1e-3
"""Metres, radians and so on: what varies less is noise, and is not magnified further."""
_HIDDEN = 128


def imitation_loss(
    agent: Agent,
    merged: Tensor,
    state: Tensor,
    label: Tensor,
    weights: Tensor,
    gripper_loss: str = "square",
) -> Tensor:
    """Weighted error of every row's deterministic action to the expert's.

    merged (N, B, ...), state (B, S), label (B, A), weights (N,) -> scalar.
    """
    return (row_errors(agent, merged, state, label, gripper_loss) * weights).sum()


def row_errors(
    agent: Agent, merged: Tensor, state: Tensor, label: Tensor, gripper_loss: str = "square"
) -> Tensor:
    """(N,) mean squared errors of the actions on ``merged`` (N, B, ...); with ``cross-entropy`` the
    last number of an action counts as a choice."""
    rows, batch = merged.shape[:2]
    mean, _ = agent.actor(merged.flatten(0, 1), state.repeat(rows, 1))
    error = (torch.tanh(mean).unflatten(0, (rows, batch)) - label).square()
    if gripper_loss == "cross-entropy":
        choice = choice_errors(mean[:, -1].unflatten(0, (rows, batch)), label[:, -1])
        error = torch.cat([error[..., :-1], choice[..., None]], -1)
    return error.mean((1, 2))


def choice_errors(mean: Tensor, label: Tensor) -> Tensor:
    """An action x = tanh(m) taken as the chance p = (1 + x) / 2 of the choice 1 against -1: the
    Kullback-Leibler divergence of p from the expert's, 0 where they agree.

    mean (..., B) before tanh, label (B,) -> (..., B). As tanh(m) = 2 sigmoid(2 m) - 1, the logit of
    p is 2 m; unlike a squared error's, its gradient does not vanish where tanh saturates wrongly.
    """
    chance = (1 + label.float()) / 2
    found = F.binary_cross_entropy_with_logits(
        2 * mean.float(), chance.expand_as(mean), reduction="none"
    )
    least = -(torch.xlogy(chance, chance) + torch.xlogy(1 - chance, 1 - chance))
    return found - least


class PlacesHead(nn.Module):
    """Tells places from what the actor's MLP reads. Its unit is the spread of each coordinate."""

    mean: Tensor
    spread: Tensor

    def __init__(self, actor: ActorHead, places: Array) -> None:
        """``places`` (T, 3 P): those of the demonstrations, see ``check_places``."""
        super().__init__()
        assert isinstance(actor, Actor)  # Any other was refused.
        first = actor.mlp[0]
        assert isinstance(first, nn.Linear)
        self.mlp = nn.Sequential(
            nn.Linear(first.in_features, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, places.shape[1])
        )
        mean, spread = mean_and_std(places)
        self.register_buffer("mean", torch.tensor(mean))
        self.register_buffer("spread", torch.tensor(spread))

    def row_errors(self, actor: ActorHead, merged: Tensor, state: Tensor, places: Tensor) -> Tensor:
        """(N,) mean squared errors on ``merged`` (N, B, Z); state (B, S), places (B, 3 P)."""
        assert isinstance(actor, Actor)  # Any other was refused.
        rows = len(merged)
        found = self.mlp(actor.inputs(merged, state.expand(rows, *state.shape))).float()
        return (found - (places - self.mean) / self.spread).square().mean((1, 2))


def check_places(actor: ActorHead, env: Environment) -> None:
    """Raises UserError for an environment that does not tell places, and for an actor that reads
    every view for itself: neither has what a ``PlacesHead`` needs."""
    if not isinstance(env, KnowsPlaces):
        raise UserError(
            "expected an environment that tells where objects and goal are for "
            "--light.position-weight, found one that does not; give it a method places() "
            "(madviz.types.KnowsPlaces), or leave the option out"
        )
    if not isinstance(actor, Actor):
        raise UserError(
            "expected a merge with one feature for --light.position-weight, found q-mean, "
            "which has none; choose another merge, or leave the option out"
        )


def mean_and_std(numbers: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Per column of (T, K): its mean, and its standard deviation where that is more than
    ``SMALLEST_SPREAD``."""
    mean = numbers.mean(0, dtype=float)
    spread = numbers.std(0, dtype=float).clip(SMALLEST_SPREAD)
    return tuple(map(float, mean)), tuple(map(float, spread))
