"""A tiny MV-MWM agent, and its formulas once more: in float64, a sample and a gate at a time."""

from __future__ import annotations

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import SETTINGS
from madviz.types import Array, PolicySpec
from madviz.world_model.mv_mwm import WorldNetworks
from madviz.world_model.mv_mwm_options import SIZES
from madviz.world_model.rssm import Belief
from tests.test_merges import Weights, layer_norm, linear, perturb, softmax

GROUPS, CLASSES, MEMORY = 4, 4, 16
"""The sizes of a tiny world model."""


STREAMS = SETTINGS["three"].streams
TINY = SIZES["tiny"]
NETWORKS = NetworkConfig(6, 2, hidden_dim=8, own=TINY.own)
T, L, B = 4, 2, 3
"""Frames, decisions and samples of a window: the stack has two frames."""


def make() -> Agent:
    torch.manual_seed(0)
    agent = Agent(NETWORKS, merge="mv-mwm", streams=STREAMS)
    perturb(agent)
    return agent


def net_of(agent: Agent) -> WorldNetworks:
    assert isinstance(agent.encoder, WorldNetworks)
    return agent.encoder


def policy_of(agent: Agent) -> TorchPolicy:
    spec = PolicySpec("p", "toy/reach", "mv-mwm", "three", "mv-mwm", STREAMS, ("all",))
    return TorchPolicy(spec, agent)


def normal(*shape: int, seed: int = 1) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def uniform(*shape: int, seed: int = 2) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(shape))


def believed(agent: Agent, batch: int = B) -> Belief:
    rssm = net_of(agent).world.rssm
    with torch.no_grad():
        return rssm.observe(normal(2, batch, 64), None)


# --- The formulas ------------------------------------------------------------------------------


def sigmoid(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))


def mlp(w: Weights, name: str, x: Array, layers: int = 1) -> Array:
    for layer in range(layers):
        x = layer_norm(w, f"{name}.{3 * layer + 1}", linear(w, f"{name}.{3 * layer}", x))
        x = x * sigmoid(x)
    return linear(w, f"{name}.{3 * layers}", x)


def attended(query: Array, key: Array, value: Array, heads: int) -> Array:
    size = query.shape[1] // heads
    parts = [slice(size * h, size * (h + 1)) for h in range(heads)]
    answers = [
        np.concatenate([softmax(key[:, h] @ q[h] / size**0.5) @ value[:, h] for h in parts])
        for q in query
    ]
    return np.stack(answers)


def each(w: Weights, name: str, rows: Array, how=linear) -> Array:
    return np.stack([how(w, name, row) for row in rows])


def seen(w: Weights, tokens: Array) -> Array:
    """(K, W) tokens through the autoencoder's one layer."""
    layer = "autoencoder.encoder.layers.0"
    inner, bias = w[f"{layer}.self_attn.in_proj_weight"], w[f"{layer}.self_attn.in_proj_bias"]
    normed = each(w, f"{layer}.norm1", tokens, layer_norm)
    answers = attended(*np.split(normed @ inner.T + bias, 3, axis=1), heads=2)
    x = tokens + each(w, f"{layer}.self_attn.out_proj", answers)
    wide = each(w, f"{layer}.linear1", each(w, f"{layer}.norm2", x, layer_norm))
    wide = wide * stats.norm.cdf(wide)
    return each(w, "autoencoder.norm", x + each(w, f"{layer}.linear2", wide), layer_norm)


def embedded(w: Weights, features: Array) -> Array:
    narrow = each(w, "world.narrow", features)
    key, value = each(w, "world.reader.key", narrow), each(w, "world.reader.value", narrow)
    return attended(w["world.reader.questions"], key, value, heads=4).ravel()


def advanced(w: Weights, memory: Array, latent: Array, action: Array | None) -> Array:
    """A GRU's cell, gate by gate."""
    done = np.zeros(3) if action is None else np.append(action, 1)
    x = linear(w, "world.rssm.inputs.0", np.concatenate([latent, done]))
    x = layer_norm(w, "world.rssm.inputs.1", x)
    cell, x = "world.rssm.cell", x * sigmoid(x)
    reads = np.split(w[f"{cell}.weight_ih"] @ x + w[f"{cell}.bias_ih"], 3)
    keeps = np.split(w[f"{cell}.weight_hh"] @ memory + w[f"{cell}.bias_hh"], 3)
    reset, update = (sigmoid(reads[i] + keeps[i]) for i in range(2))
    new = np.tanh(reads[2] + reset * keeps[2])
    return (1 - update) * new + update * memory


def drawn(logits: Array, noise: Array | None) -> Array:
    """One-hot, by the inverse of each choice's cumulative probabilities."""
    rows = []
    for g, row in enumerate(logits.reshape(GROUPS, CLASSES)):
        index = row.argmax()
        if noise is not None:
            index = np.searchsorted(np.cumsum(softmax(row)), noise[g], side="right")
        rows.append(np.eye(CLASSES)[index])
    return np.concatenate(rows)


def corrected(w: Weights, memory: Array, embedding: Array) -> Array:
    return mlp(w, "world.rssm.posterior", np.concatenate([memory, embedding]))


def rebuilt(w: Weights, embeddings: Array, noise: Array | None) -> tuple[Array, Array]:
    memory, latent = np.zeros(MEMORY), np.zeros(GROUPS * CLASSES)
    for t, embedding in enumerate(embeddings):
        memory = advanced(w, memory, latent, None)
        latent = drawn(corrected(w, memory, embedding), None if noise is None else noise[t])
    return memory, latent


def kl(one: Array, other: Array) -> float:
    pairs = zip(one.reshape(GROUPS, CLASSES), other.reshape(GROUPS, CLASSES), strict=True)
    return float(sum(stats.entropy(softmax(p), softmax(q)) for p, q in pairs))
