"""MAD's losses, one plain function each, named after the paper's terms.

Every sample is read in N rows: row 0 is the merged feature M, the others are singular subsets of
its streams (``methods.py``). A loss function returns one number per row, so that the paper's
objective is a weighted sum in plain sight: ``weighted(losses, {"merged": 0.8, "singular": 0.2})``.

What makes it MAD is *where Q is read*. Learning targets come from merged features alone:

                  acts on           its Q is read on     regressed on / ascends
    target        M' (actor)        M' (target critic)   y = r + d (min Q'(M', a') - T log pi(a'))
    critic        stored action     every row            y, the same for all rows
    actor         every row         M, critic fixed      min Q(M, a) - T log pi(a)
    temperature   every row         -                    entropy -A

so a camera alone is never its own teacher. The argument ``reads`` holds the features Q is read on:
(R, B, Z) with R = 1, the merged one, for MAD; R = N, each row's own, for a method without the rule.

Randomness is an argument everywhere: the functions are pure, and a test can compute them again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Integer
from torch import Tensor

from madviz.agent.agent import Agent
from madviz.agent.networks import squash


@dataclass(frozen=True)
class Batch:
    """Transitions, as the replay buffer gives them: pixels are bytes, or int8 once ``shift`` has
    centred them."""

    views: Integer[Tensor, "B V C H W"]
    state: Float[Tensor, "B S"]
    action: Float[Tensor, "B A"]
    """In [-1, 1]."""
    reward: Float[Tensor, " B"]
    discount: Float[Tensor, " B"]
    """Gamma, or 0 where nothing follows that may be bootstrapped from."""
    next_views: Integer[Tensor, "B V C H W"]
    next_state: Float[Tensor, "B S"]


@torch.no_grad()
def td_target(
    agent: Agent, reads: Float[Tensor, "R B ..."], batch: Batch, noise: Float[Tensor, "R B A"]
) -> Float[Tensor, "R B"]:
    """y from the next step's ``reads``; ``noise`` draws a' from the actor."""
    state = _tile(batch.next_state, len(reads))
    mean, log_std = agent.actor(reads, state)  # (R, B, A) each
    action, log_prob = squash(mean, log_std, noise)  # (R, B, A), (R, B)
    q = torch.minimum(*agent.target(reads, state, action))  # (R, B); twins, against overestimation
    value = q - agent.log_temperature.exp() * log_prob
    return batch.reward + batch.discount * value


def critic_losses(
    agent: Agent,
    rows: Float[Tensor, "N B ..."],
    state: Float[Tensor, "B S"],
    action: Float[Tensor, "B A"],
    target: Float[Tensor, "R B"],
) -> Float[Tensor, " N"]:
    """Squared errors of ``rows`` against ``target``: summed over the twins, mean over B."""
    count = len(rows)
    q1, q2 = agent.critic(rows, _tile(state, count), _tile(action, count))  # (N, B) each
    # With R = 1 every row has the merged row's target: that is what makes the views agree.
    return ((q1 - target).square() + (q2 - target).square()).mean(1)


def actor_losses(
    agent: Agent,
    rows: Float[Tensor, "N B ..."],
    batch: Batch,
    noise: Float[Tensor, "N B A"],
    reads: Float[Tensor, "R B ..."],
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N B"]]:
    """T log pi(a|row) - min Q(read, a), mean over B; and log pi.

    Features are taken as data: the encoder learns from the critic alone.
    """
    state = _tile(batch.state, len(rows))
    mean, log_std = agent.actor(rows.detach(), state)  # (N, B, A) each
    action, log_prob = squash(mean, log_std, noise)  # (N, B, A), (N, B)
    # One projection of M serves the N actions that are judged on it.
    hidden = agent.critic.trunk(reads.detach())  # (R, B, 50)
    hidden = hidden.expand(len(rows), *hidden.shape[1:])  # (N, B, 50)
    q = torch.minimum(*agent.critic.heads(hidden, state, action))  # (N, B)
    temperature = agent.log_temperature.detach().exp()
    return (temperature * log_prob - q).mean(1), log_prob


def temperature_losses(agent: Agent, log_prob: Float[Tensor, "N B"]) -> Float[Tensor, " N"]:
    """T (-log pi - H), mean over B, with target entropy H = -A; log pi is data."""
    target_entropy = -agent.config.action_dim
    return (agent.log_temperature.exp() * (-log_prob.detach() - target_entropy)).mean(1)


def merged(losses: Float[Tensor, " N"]) -> Float[Tensor, ""]:
    """The paper's UnAug term: the merged row's."""
    return losses[0]


def singular(losses: Float[Tensor, " N"]) -> Float[Tensor, ""]:
    """The paper's Aug terms, 1/n of each: the mean over the singular rows."""
    return losses[1:].mean()


def every(losses: Float[Tensor, " N"]) -> Float[Tensor, ""]:
    """Not the paper's formulation: the mean over all rows, merged or not (Naive Both)."""
    return losses.mean()


TERMS = {"merged": merged, "singular": singular, "every": every}


def weighted(losses: Float[Tensor, " N"], weights: Mapping[str, float]) -> Float[Tensor, ""]:
    """The objective: losses of the rows to one number, by a method's ``weights``."""
    return torch.stack([weight * TERMS[name](losses) for name, weight in weights.items()]).sum()


def _tile(x: Tensor, count: int) -> Tensor:
    """(B, ...) -> (count, B, ...) without copying."""
    return x.expand(count, *x.shape)
