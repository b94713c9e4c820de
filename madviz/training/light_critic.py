"""The light recipe's critic: fitted at the end, on features that no longer change.

The actor learned by imitation and needed no critic; the page wants to show Q. So after the last
round the recorded episodes are encoded once, and the critic is fitted to the rewards in them
with the method's critic loss. For MAD every row is regressed on one target, read from merged
features,

    y_t = r_t + g r_{t+1} + ... + g^9 r_{t+9} + g^10 min Q'(M_{t+10}, pi(M_{t+10}))

(fewer terms near the end of an episode, always bootstrapped from the last state there is). Ten real
rewards and g = 0.97 make 1,500 updates enough. It is the value of the recorded behaviour for ten
decisions and of the trained actor from there on. Rewards of up to 20 a decision are scaled by 0.05.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from madviz.agent.agent import Agent, autocast
from madviz.agent.merges.base import Noise
from madviz.agent.merges.merge_table import MERGES
from madviz.agent.methods import Method
from madviz.agent.objectives import critic_losses, weighted
from madviz.runs.demonstrations import Dataset
from madviz.types import Array

REWARD_SCALE = 0.05
GAMMA = 0.97
STEPS = 10
MOST_EPISODES = 100
"""The newest episodes that are encoded: 190 MB of features with three streams."""
_BATCH = 256
_LEARNING_RATE = 5e-4
_TARGET_RATE = 0.02


def n_step_returns(rewards: Array, horizon: int) -> tuple[Array, Array, Array]:
    """Discounted sums of the next up to ten rewards, for episodes laid end to end.

    rewards (T,) -> sums (T,), the index each bootstraps from (T,), and its discount (T,). The last
    decision of an episode has nothing after it and bootstraps from itself.
    """
    index = np.arange(len(rewards))
    last = index - index % horizon + horizon - 1
    sums = np.zeros(len(rewards), np.float32)
    discount = np.ones(len(rewards), np.float32)
    for k in range(STEPS):
        inside = index + k < last
        sums[inside] += discount[inside] * rewards[index[inside] + k]
        discount[inside] *= GAMMA
    ahead = np.minimum(index + STEPS, last)
    only_self = index == last
    sums[only_self], discount[only_self] = rewards[only_self], GAMMA
    return sums, ahead, discount


def fit_critic(
    agent: Agent, data: Dataset, method: Method, alpha: float, updates: int, seed: int
) -> float:
    """Trains ``agent.critic`` in place, nothing else; returns the mean loss of the last tenth."""
    streams = data.streams
    rng = np.random.default_rng([seed, 11])
    index = np.arange(max(0, data.episodes - MOST_EPISODES) * data.horizon, len(data))
    masks = torch.from_numpy(method.masks(streams))
    weights = method.weights(alpha)
    features = _encode(agent, data, index, masks)
    rewards = data.column("rewards", index).numpy() * REWARD_SCALE
    sums, ahead, discount = n_step_returns(rewards, data.horizon)
    state = data.column("states", index)
    action = data.column("actions", index)
    reads = masks[:1] if method.targets == "merged" else masks
    generator = torch.Generator().manual_seed(seed)
    critic = agent.critic.requires_grad_(True).train()
    target = agent.target
    target.load_state_dict(critic.state_dict())
    optimiser = torch.optim.Adam(critic.parameters(), lr=_LEARNING_RATE, fused=True)
    losses = []
    for _ in range(updates):
        rows = rng.integers(0, len(index), _BATCH)
        drawn = agent.encoder.noise(_BATCH, generator)
        next_value = _value(agent, features[ahead[rows]], state[ahead[rows]], reads, drawn)
        y = torch.from_numpy(sums[rows]) + torch.from_numpy(discount[rows]) * next_value
        with autocast():
            merged = _rows(agent, features[rows], masks, drawn)
            loss = weighted(critic_losses(agent, merged, state[rows], action[rows], y), weights)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        with torch.no_grad():
            for slow, fast in zip(target.parameters(), critic.parameters(), strict=True):
                slow.lerp_(fast, _TARGET_RATE)
    critic.requires_grad_(False).eval()
    return float(np.mean(losses[-max(1, updates // 10) :])) if losses else float("nan")


@torch.no_grad()
def _value(agent: Agent, features: Tensor, state: Tensor, reads: Tensor, noise: Noise) -> Tensor:
    """Features of B samples, (B, S), masks (R, V) -> (R, B) min of the target twins for the actor's
    mean action, on each of the R rows."""
    with autocast():
        rows = _rows(agent, features, reads, noise)
        states = state.expand(len(rows), *state.shape)
        action = torch.tanh(agent.actor(rows, states)[0])
        return torch.minimum(*agent.target(rows, states, action))


@torch.no_grad()
def _encode(agent: Agent, data: Dataset, index: Array, masks: Tensor) -> Tensor:
    """Features of the decisions ``index`` in the merge's layout, (T, V, Z) for a sum; in bfloat16
    where that is fast. Where rows are costly, the rows of ``masks`` themselves, (T, N, ...)."""
    chunks = []
    for start in range(0, len(index), 64):
        with autocast():
            features = agent.encoder.encode(data.views(index[start : start + 64]))
            if MERGES[agent.merge_name].costly_rows:
                features = agent.encoder.rows(features, masks).transpose(0, 1)
            chunks.append(features)
    return torch.cat(chunks)


def _rows(agent: Agent, features: Tensor, masks: Tensor, noise: Noise) -> Tensor:
    """(N, B, ...), the rows of ``masks`` from what ``_encode`` made, which begins with them where
    it holds rows."""
    if MERGES[agent.merge_name].costly_rows:
        return features[:, : len(masks)].transpose(0, 1)
    return agent.encoder.rows(features, masks, noise)
