"""Every merge against a second computation of it, one sample and one view at a time in float64."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.agent import Agent
from madviz.agent.merges import merge_table
from madviz.agent.merges.merge_table import MERGES, merge_class, own_options
from madviz.agent.merges.vib import VibOptions
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import SETTINGS
from madviz.errors import UserError
from madviz.subsets import every_mask
from madviz.types import Array

NETWORKS = NetworkConfig(state_dim=5, action_dim=2, hidden_dim=8, own=VibOptions(6))
STREAMS, RGBD = SETTINGS["three"].streams, SETTINGS["three-rgbd"].streams
B, V, Z = 2, 3, 3136
Weights = dict[str, Array]


def make(merge: str, streams: tuple[str, ...] = STREAMS) -> Agent:
    """In float64, and with biases and norms that are not 0 and 1, which would hide mistakes."""
    torch.manual_seed(0)
    agent = Agent(NETWORKS, merge=merge, streams=streams).double()
    with torch.no_grad():
        for parameter in agent.parameters():
            if parameter.dim() == 1:
                parameter.add_(0.1 * torch.randn_like(parameter))
    return agent


def perturb(network: nn.Module, by: float = 0.1) -> None:
    """Moves every parameter, so that none is 0 or 1, which would hide mistakes."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(by * torch.randn_like(parameter))


def numbers(*shape: int, seed: int = 1) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def pictures(seed: int = 2) -> Tensor:
    images = np.random.default_rng(seed).integers(0, 256, (B, V, 9, 84, 84), np.uint8)
    return torch.from_numpy(images)


def weights(module: nn.Module) -> Weights:
    return {name: t.detach().numpy() for name, t in module.state_dict().items()}


def supported(merge: str) -> Array:
    return np.array([mask for mask in every_mask(V) if MERGES[merge].support.allows(mask)])


def close(found: Tensor, expected: Array) -> None:
    np.testing.assert_allclose(found.detach().numpy(), expected, rtol=1e-9, atol=1e-9)


def linear(w: Weights, name: str, x: Array) -> Array:
    return w[f"{name}.weight"] @ x + w.get(f"{name}.bias", 0)


def layer_norm(w: Weights, name: str, x: Array) -> Array:
    x = (x - x.mean()) / np.sqrt(((x - x.mean()) ** 2).mean() + 1e-5)
    return x * w[f"{name}.weight"] + w[f"{name}.bias"]


def softmax(x: Array) -> Array:
    return np.exp(x - x.max()) / np.exp(x - x.max()).sum()


def cnn(net: nn.Module, picture: Tensor) -> Tensor:
    """uint8 (C, 84, 84) -> (3136,)."""
    x = picture.double()[None] / 255 - 0.5
    for name, stride in (("conv1", 4), ("conv2", 2), ("conv3", 1)):
        conv = getattr(net, name)
        x = F.conv2d(x, conv.weight, conv.bias, stride=stride).clamp(min=0)
    return x.reshape(-1)


# --- Before the heads ------------------------------------------------------------------------


def test_concat_puts_features_side_by_side() -> None:
    agent, features = make("concat"), numbers(B, V, Z)
    found = agent.encoder.rows(features, torch.ones(1, V))
    assert found.shape == (1, B, V * Z)
    for b in range(B):
        close(found[0, b], np.concatenate([features[b, v].numpy() for v in range(V)]))
    assert agent.actor.trunk.linear.weight.shape == (50, V * Z)  # type: ignore[union-attr]


def test_frame_stack_sees_one_picture_of_all_channels() -> None:
    agent, views = make("frame-stack"), pictures()
    features = agent.encoder.encode(views)
    assert features.shape == (B, Z) and agent.encoder.conv1.weight.shape[1] == V * 9  # type: ignore[union-attr]
    for b in range(B):
        picture = torch.cat([views[b, v] for v in range(V)])
        close(features[b], cnn(agent.encoder, picture).detach().numpy())
    assert torch.equal(agent.encoder.rows(features, torch.ones(1, V))[0], features)


def attended(w: Weights, maps: list[Array], mask: Array) -> Array:
    """Cross-attention from every present view's 49 places to the others', then the sum."""
    tokens = [feature.reshape(64, 49).T for feature in maps]
    normed = [np.stack([layer_norm(w, "norm", t) for t in view]) for view in tokens]
    merged = np.zeros((49, 64))
    for v in np.flatnonzero(mask):
        others = [o for o in np.flatnonzero(mask) if o != v]
        merged += tokens[v]
        if not others:
            continue
        keys = np.concatenate([normed[o] for o in others])
        for place in range(49):
            q = w["query.weight"] @ normed[v][place]
            k, values = keys @ w["key.weight"].T, keys @ w["value.weight"].T
            heads = [slice(16 * h, 16 * h + 16) for h in range(4)]
            answer = [softmax(k[:, h] @ q[h] / 4) @ values[:, h] for h in heads]
            merged[place] += w["out.weight"] @ np.concatenate(answer)
    return merged.T.reshape(-1)


def test_attention_is_the_formula_for_every_subset() -> None:
    agent, features = make("attention"), numbers(1, V, Z)
    masks = supported("attention")
    found = agent.encoder.rows(features, torch.from_numpy(masks))
    assert found.shape == (7, 1, Z)
    for mask, row in zip(masks, found, strict=True):
        maps = [features[0, v].numpy() for v in range(V)]
        close(row[0], attended(weights(agent.encoder), maps, mask))
        if mask.sum() == 1:
            close(row[0], features[0, mask.argmax()].numpy())


def transformed(w: Weights, features: list[Array], mask: Array) -> Array:
    present = np.flatnonzero(mask)
    tokens = {v: linear(w, "project", features[v]) + w["place"][v] for v in present}
    normed = {v: layer_norm(w, "norm1", token) for v, token in tokens.items()}
    out = []
    for v in present:
        q = linear(w, "query", normed[v])
        k = np.stack([linear(w, "key", normed[o]) for o in present])
        values = np.stack([linear(w, "value", normed[o]) for o in present])
        heads = [slice(32 * h, 32 * h + 32) for h in range(4)]
        answer = [softmax(k[:, h] @ q[h] / math.sqrt(32)) @ values[:, h] for h in heads]
        x = tokens[v] + linear(w, "out", np.concatenate(answer))
        wide = linear(w, "widen", layer_norm(w, "norm2", x))
        gelu = np.array([0.5 * n * (1 + math.erf(n / math.sqrt(2))) for n in wide])
        out.append(x + linear(w, "narrow", gelu))
    return np.mean(out, 0)


def test_the_transformer_is_the_formula_for_every_subset() -> None:
    agent, features = make("vit"), numbers(B, V, Z)
    masks = supported("vit")
    found = agent.encoder.rows(features, torch.from_numpy(masks))
    assert found.shape == (7, B, 128)
    for mask, row in zip(masks, found, strict=True):
        for b in range(B):
            each = [features[b, v].numpy() for v in range(V)]
            close(row[b], transformed(weights(agent.encoder), each, mask))


# --- After the heads -------------------------------------------------------------------------


def test_q_mean_averages_what_the_heads_say_of_each_view() -> None:
    agent, features = make("q-mean"), numbers(B, V, Z)
    state, action = numbers(B, 5, seed=3), numbers(B, 2, seed=4)
    masks = supported("q-mean")
    rows = agent.encoder.rows(features, torch.from_numpy(masks))
    n = len(masks)
    mean, log_std = agent.actor(rows, state.expand(n, -1, -1))
    q1, q2 = agent.critic(rows, state.expand(n, -1, -1), action.expand(n, -1, -1))
    assert mean.shape == log_std.shape == (n, B, 2) and q1.shape == q2.shape == (n, B)
    alone = [agent.actor.each(features[:, v], state) for v in range(V)]  # type: ignore[operator]
    judged = [agent.critic.each(features[:, v], state, action) for v in range(V)]  # type: ignore[operator]
    for index, mask in enumerate(masks):
        present = np.flatnonzero(mask)
        for found, each in ((mean, 0), (log_std, 1)):
            close(found[index], sum(alone[v][each].detach().numpy() for v in present) / mask.sum())
        for found, twin in ((q1, 0), (q2, 1)):
            close(found[index], sum(judged[v][twin].detach().numpy() for v in present) / mask.sum())
        shown = agent.encoder.merged_feature(rows)[index]
        close(shown, features.numpy()[:, present].mean(1))


def test_q_mean_is_blind_to_absent_views() -> None:
    agent, features = make("q-mean"), numbers(B, V, Z)
    mask, other = torch.tensor([[1, 0, 1]]), features.clone()
    other[:, 1] += 100
    state = numbers(1, B, 5)
    one, two = (agent.actor(agent.encoder.rows(f, mask), state)[0] for f in (features, other))
    assert torch.equal(one, two)


# --- What a merge can do without -------------------------------------------------------------


def test_every_row_of_the_table_has_a_file_of_its_name() -> None:
    files = [merge_class(name).__module__.rpartition(".")[2] for name in MERGES]
    assert [file.replace("_", "-") for file in files] == list(MERGES)
    folder = Path(merge_table.__file__).parent
    here = {file.stem for file in folder.glob("[a-z]*.py")} - {"base", "merge_table"}
    assert here < set(files), "a merge that no row names"


def test_own_sizes_are_options_that_the_networks_are_built_from() -> None:
    with_own = {name: own_options(name) for name, row in MERGES.items() if row.options}
    assert {"vib", "mv-mae", "mv-mwm"} <= set(with_own)
    common = {size.name for size in fields(NetworkConfig)}
    for name, kind in with_own.items():
        sizes = set(MERGES[name].sizes)
        assert sizes and sizes <= {option.name for option in fields(kind)}
        assert not sizes & common, "they stand beside each other in config.json"


def test_the_table_says_which_merges_bring_a_loss() -> None:
    for name, merge in MERGES.items():
        agent = make(name)
        penalty = agent.encoder.penalty(agent.encoder.encode(pictures()))
        assert merge.own_loss == (bool(agent.encoder.own_optimiser) or penalty is not None)


@pytest.mark.parametrize(
    ("merge", "expected"),
    [
        ("sum", "11111111"), ("concat", "10000000"), ("frame-stack", "10000000"),
        ("attention", "11111110"), ("vit", "11111110"), ("q-mean", "11111110"),
        ("mvd", "11111110"), ("vib", "10010110"), ("mv-mae", "11111110"),
        ("mv-mwm", "11111110"),
    ],
)  # fmt: skip
def test_what_a_merge_can_do_without(merge: str, expected: str) -> None:
    found = "".join(str(int(MERGES[merge].support.allows(mask))) for mask in every_mask(V))
    assert found == expected


@pytest.mark.parametrize("merge", ["attention", "vit", "q-mean", "sum"])
def test_an_absent_view_changes_nothing(merge: str) -> None:
    agent, features = make(merge), numbers(B, V, Z)
    other = features.clone()
    other[:, 2] = 1e3 * numbers(B, Z, seed=9)
    mask = torch.tensor([[True, True, False]])
    assert torch.equal(agent.encoder.rows(features, mask), agent.encoder.rows(other, mask))


def test_an_unknown_merge_is_refused_by_name() -> None:
    with pytest.raises(UserError, match="unknown merge 'product'; known: attention"):
        Agent(NETWORKS, merge="product", streams=STREAMS)


def test_gradients_are_finite_where_a_view_is_alone() -> None:
    for merge in ("attention", "vit", "q-mean"):
        agent = make(merge)
        features = numbers(B, V, Z).requires_grad_()
        agent.encoder.rows(features, torch.eye(V)).square().sum().backward()
        assert features.grad is not None and features.grad.isfinite().all(), merge
