"""Merging late: one actor and one critic, asked once per view, and the mean of what they say.

    V_1 -> Q(V_1, a) --.                       V_1 -> mean, log std --.
    V_2 -> Q(V_2, a) ---> mean over present    V_2 -> mean, log std ---> mean over present
    V_3 -> Q(V_3, a) --'    views = Q(a)       V_3 -> mean, log std --'  views = the policy

The paper's Q-mean averages Q over the views (paper, merge methods); how its actor acts is published
nowhere. Here the actor is averaged the same way, before tanh and before a number is drawn, because
a mean of Gaussians' parameters is again one Gaussian: entropy and log-probability stay exact, and
with one view left both are that view's own. The twins are averaged each for itself; their minimum
is taken afterwards, as in every other method.

A row that these heads read is (..., V, Z + 1): every view's feature, and in the last column 1 where
the view is present and 0 where it is not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from madviz.agent.merges.base import Heads, Noise, SharedCnn
from madviz.agent.networks import Actor, ActorHead, Critic, CriticHead, NetworkConfig


def mean_of_present(values: Tensor, present: Tensor) -> Tensor:
    """(..., V, K), (..., V) of 0 and 1 -> (..., K)."""
    weights = present.to(values.dtype)
    total = (values * weights[..., None]).sum(-2)
    return total / weights.sum(-1, keepdim=True).clamp(min=1)


class PerViewActor(ActorHead):
    """The mean of one actor's answers to every present view."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.each = Actor(config)

    def forward(self, rows: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """(..., V, Z + 1), (..., S) -> mean and log standard deviation before tanh, (..., A)."""
        features = rows[..., :-1]
        present = rows[..., -1]
        mean, log_std = self.each(features, _per_view(state, present))
        return mean_of_present(mean, present), mean_of_present(log_std, present)


class PerViewCritic(CriticHead):
    """The mean of one critic's answers to every present view."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.each = Critic(config)

    def trunk(self, rows: Tensor) -> Tensor:
        """(..., V, Z + 1) -> (..., V, 50 + 1): projected, and still saying who is present."""
        hidden = self.each.trunk(rows[..., :-1])
        return torch.cat([hidden, rows[..., -1:].to(hidden.dtype)], -1)

    def heads(self, hidden: Tensor, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The part behind the trunk, for (..., S) and (..., A) -> Q1, Q2, (...,) each."""
        present = hidden[..., -1]
        twins = self.each.heads(
            hidden[..., :-1], _per_view(state, present), _per_view(action, present)
        )
        q1, q2 = (mean_of_present(q[..., None], present)[..., 0] for q in twins)
        return q1, q2


def _per_view(x: Tensor, present: Tensor) -> Tensor:
    """(..., K) -> (..., V, K), the same for every view."""
    return x.unsqueeze(-2).expand(*present.shape, x.shape[-1])


class QMean(SharedCnn):
    """See the file."""

    def heads(self, config: NetworkConfig) -> Heads:
        return PerViewActor(config), PerViewCritic(config)

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        """(B, V, Z), (N, V) -> (N, B, V, Z + 1): features of present views, and who is present."""
        present = masks.to(features.dtype)[:, None, :, None].expand(-1, len(features), -1, 1)
        return torch.cat([features * present, present], -1)

    def merged_feature(self, rows: Tensor) -> Tensor:
        """(..., V, Z + 1) -> (..., Z), for showing only: nothing is merged before the heads."""
        return mean_of_present(rows[..., :-1], rows[..., -1])
