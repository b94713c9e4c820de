"""MVD's and VIB's representations, losses and updates against second computations in float64."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.augment import shift
from madviz.agent.merges.mvd import (
    TwoPartEncoder,
    contrastive_loss,
    drawn,
    private_loss,
    shared_loss,
)
from madviz.agent.merges.vib import BottleneckEncoder, VibOptions, kl_loss
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.agent.objectives import Batch, critic_losses, td_target
from madviz.agent.update import Learner, LearningConfig
from madviz.envs.registry import SETTINGS
from madviz.types import Array, PolicySpec

STREAMS = SETTINGS["three"].streams
B, V, L, Z = 3, 3, 6, 3136
NETWORKS = NetworkConfig(state_dim=5, action_dim=2, hidden_dim=8, own=VibOptions(L))


def make(merge: str, seed: int = 0) -> Agent:
    torch.manual_seed(seed)
    agent = Agent(NETWORKS, merge=merge, streams=STREAMS).double()
    with torch.no_grad():
        for parameter in agent.parameters():
            if parameter.dim() == 1:
                parameter.add_(0.1 * torch.randn_like(parameter))
    return agent


def learner(agent: Agent, method: str) -> Learner:
    config = LearningConfig(precision="float32", same_shift_for_views=False)
    return Learner(agent, METHODS[method], STREAMS, config, seed=3)


def numbers(*shape: int, seed: int = 1) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def make_batch(seed: int = 0) -> Batch:
    rng = np.random.default_rng(seed)
    views, following = torch.from_numpy(rng.integers(0, 256, (2, B, V, 9, 84, 84), np.uint8))
    state, next_state, action = (numbers(B, n, seed=seed + n) for n in (5, 5, 2))
    reward, discount = numbers(B, seed=seed + 8), torch.full((B,), 0.99).double()
    return Batch(views, state, action.tanh(), reward, discount, following, next_state)


# --- MVD: the losses -------------------------------------------------------------------------


def cosine(a: Array, b: Array) -> float:
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def info_nce(query: Array, positive: Array, negatives: list[Array]) -> float:
    """-log of the positive's share among all keys, cosine over 0.1."""
    scores = np.exp([cosine(query, key) / 0.1 for key in (positive, *negatives)])
    return float(-np.log(scores[0] / scores.sum()))


def test_the_contrastive_losses_are_the_formulas() -> None:
    features, following = numbers(B, V, 100), numbers(B, V, 50, seed=2)
    s, p, after = features[..., :50].numpy(), features[..., 50:].numpy(), following.numpy()
    positive, total = 1, []
    for a in (0, 2):
        among_batch = [
            info_nce(s[b, a], s[b, positive], [s[o, positive] for o in range(B) if o != b])
            for b in range(B)
        ]
        among_private = [
            info_nce(s[b, a], s[b, positive], [p[b, c] for c in range(V)]) for b in range(B)
        ]
        own = [info_nce(p[b, a], after[b, a], [p[b, positive]]) for b in range(B)]
        shared = (np.mean(among_batch) + np.mean(among_private)) / 2
        found = shared_loss(features[:, a, :50], features[:, positive, :50], features[..., 50:])
        assert found.item() == pytest.approx(shared, rel=1e-9)
        found = private_loss(features[:, a, 50:], following[:, a], features[:, positive, 50:])
        assert found.item() == pytest.approx(np.mean(own), rel=1e-9)
        total.append(shared + np.mean(own))
    found = contrastive_loss(features, following, positive)
    assert found.item() == pytest.approx(np.mean(total), rel=1e-9)


def test_nothing_is_learned_through_keys() -> None:
    features, following = numbers(B, V, 100).requires_grad_(), numbers(B, V, 50).requires_grad_()
    contrastive_loss(features, following, positive=1).backward()
    assert following.grad is None and features.grad is not None
    assert (features.grad[:, 1] == 0).all(), "the positive view is a key only"
    assert (features.grad[:, [0, 2]] != 0).any(-1).all()


# --- MVD: the draw ---------------------------------------------------------------------------


def test_two_views_are_drawn_evenly_from_the_present_ones() -> None:
    generator = torch.Generator().manual_seed(0)
    agent, masks = make("mvd"), torch.tensor([[True, True, True], [True, False, True]])
    keys = [agent.encoder.noise(B, generator) for _ in range(600)]
    pairs = np.stack([drawn(masks, key).numpy() for key in keys if key is not None])
    assert pairs.shape == (600, 2, 2)
    for n, expected in enumerate(([1 / 3, 1 / 3, 1 / 3], [1 / 2, 0, 1 / 2])):
        for part in (0, 1):
            share = np.bincount(pairs[:, part, n], minlength=3) / 600
            np.testing.assert_allclose(share, expected, atol=0.08)
    same = (pairs[:, 0, 0] == pairs[:, 1, 0]).mean()
    assert 0.25 < same < 0.42, "the two draws are independent"


def test_rows_are_a_shared_part_beside_a_private_part() -> None:
    agent, views = make("mvd"), make_batch().views
    keys = torch.tensor([[0.1, 0.9, 0.5], [0.2, 0.3, 0.8]])
    masks = torch.tensor([[True, True, True], [True, False, True], [True, False, False]])
    features = agent.encoder.encode(views)
    rows = agent.encoder.rows(features, masks, keys)
    for row, (i, j) in zip(rows, ((1, 2), (2, 2), (0, 0)), strict=True):
        assert torch.equal(row, torch.cat([features[:, i, :50], features[:, j, 50:]], -1))
    torch.testing.assert_close(agent.encoder.encode_and_merge(views, masks, keys)[1], rows)
    assert isinstance(agent.actor.trunk, torch.nn.Identity)


def test_a_policy_draws_from_the_pictures_and_repeats_itself() -> None:
    spec = PolicySpec("p", "toy/reach", "mvd", "three", "light", STREAMS, ("all",))
    policy = TorchPolicy(spec, make("mvd").float())
    draws, everything = set(), np.ones((1, V), bool)
    for seed in range(12):
        views, state = make_batch(seed).views[0].numpy(), np.zeros(5, np.float32)
        one, two = (policy.read(policy.encode(views, state), everything) for _ in range(2))
        np.testing.assert_array_equal(one.action, two.action)
        features = policy.encode(views, state).features
        shared = np.isclose(features[:, :50], one.merged[0, :50]).all(1)
        draws.add(int(shared.argmax()))
    assert draws == {0, 1, 2}


def test_what_a_dropped_camera_would_show_changes_no_action() -> None:
    spec = PolicySpec("p", "toy/reach", "mvd", "three", "light", STREAMS, ("all",))
    policy, mask = TorchPolicy(spec, make("mvd").float()), np.array([True, False, True])
    state = np.zeros(5, np.float32)
    for seed in range(6):
        views = make_batch(seed).views[0].numpy()
        black = np.where(mask[:, None, None, None], views, np.uint8(0))
        shown, hidden = (policy.read(policy.encode(v, state), mask) for v in (views, black))
        np.testing.assert_array_equal(shown.action, hidden.action)


# --- MVD: the update -------------------------------------------------------------------------


def test_contrast_is_a_step_of_its_own_after_everything_else() -> None:
    agent, batch = make("mvd"), make_batch()
    other = copy.deepcopy(agent)
    whole, without = learner(agent, "mvd"), learner(other, "mvd")
    draw = whole.draw(B)
    assert draw.own_loss is not None
    shifts, positive = draw.own_loss
    assert not np.array_equal(shifts, draw.shifts), "freshly shifted"
    whole.update(batch, draw)
    without.update(batch, replace(draw, own_loss=None))
    for part in ("actor", "critic", "target"):
        one, two = getattr(agent, part).state_dict(), getattr(other, part).state_dict()
        assert all(torch.equal(one[name], two[name]) for name in one), f"{part} has no part in it"

    encoder = other.encoder
    assert isinstance(encoder, TwoPartEncoder)
    now, then = shift(batch.views, shifts[0]), shift(batch.next_views, shifts[1])
    features = torch.stack([encoder(now[:, v]) for v in range(V)], 1)
    following = torch.stack([encoder.private(then[:, v]) for v in range(V)], 1)
    names, parameters = zip(*encoder.named_parameters(), strict=True)
    expected = torch.autograd.grad(contrastive_loss(features, following, positive), parameters)
    found = dict(agent.encoder.named_parameters())
    for name, before, grad in zip(names, parameters, expected, strict=True):
        stepped = before - 5e-4 * grad / (grad.abs() + 1e-8)
        torch.testing.assert_close(found[name].grad, grad, rtol=1e-6, atol=1e-9, msg=name)
        torch.testing.assert_close(found[name], stepped, rtol=1e-6, atol=1e-7, msg=name)


# --- VIB -------------------------------------------------------------------------------------


def test_the_cost_is_the_mean_divergence_of_every_number() -> None:
    mean, log_std = numbers(B, 2, L), 0.3 * numbers(B, 2, L, seed=5)
    each = [
        (m**2 + np.exp(s) ** 2 - 1) / 2 - s
        for m, s in zip(mean.numpy().ravel(), log_std.numpy().ravel(), strict=True)
    ]
    assert kl_loss(mean, log_std).item() == pytest.approx(np.mean(each), rel=1e-12)
    normal = torch.distributions.Normal
    divergence = torch.distributions.kl_divergence(normal(mean, log_std.exp()), normal(0.0, 1.0))
    assert kl_loss(mean, log_std).item() == pytest.approx(divergence.mean().item(), rel=1e-9)
    assert kl_loss(torch.zeros(1), torch.zeros(1)).item() == 0


def bottleneck(agent: Agent) -> BottleneckEncoder:
    assert isinstance(agent.encoder, BottleneckEncoder)
    return agent.encoder


def outputs(agent: Agent, slot: int, pictures: Tensor) -> Tensor:
    """What one slot makes of (B, C, H, W): (B, 2 L) of a Gaussian, or (B, Z)."""
    net = bottleneck(agent)
    feature = net.cnns[slot](pictures)
    if slot == 0:
        return feature
    gaussian = net.gaussians[str(slot)]
    return feature @ gaussian.weight.T + gaussian.bias  # type: ignore[operator,union-attr]


def representation(slots: list[Tensor], noise: Tensor) -> Tensor:
    """Third-person samples, then the first person's feature; (B, 2 L + Z)."""
    samples = [s[:, :L] + torch.exp(s[:, L:]) * noise[:, i] for i, s in enumerate(slots[1:])]
    return torch.cat([*samples, slots[0]], 1)


def test_every_mean_keeps_its_own_log_std() -> None:
    agent, views = make("vib"), make_batch().views
    noise = numbers(B, 2, L, seed=6)
    slots = [outputs(agent, v, views[:, v]) for v in range(V)]
    features, rows = agent.encoder.encode_and_merge(views, torch.ones(1, V), noise)
    torch.testing.assert_close(rows[0], representation(slots, noise))
    mean, log_std = bottleneck(agent).gaussian(features)
    for third in (0, 1):
        torch.testing.assert_close(mean[:, third], slots[1 + third][:, :L])
        torch.testing.assert_close(log_std[:, third], slots[1 + third][:, L:])


def test_acting_is_on_means_and_a_lone_view_stands_in_for_all() -> None:
    agent, views = make("vib"), make_batch().views
    masks = torch.cat([torch.ones(1, V), torch.eye(V)]).bool()
    rows = agent.encoder.rows(bottleneck(agent).encode_to_act(views), masks)
    nothing = torch.zeros(B, 2, L)
    own = [outputs(agent, v, views[:, v]) for v in range(V)]
    torch.testing.assert_close(rows[0], representation(own, nothing))
    for view in range(V):
        alone = [outputs(agent, slot, views[:, view]) for slot in range(V)]
        torch.testing.assert_close(rows[1 + view], representation(alone, nothing))


def test_the_papers_bottleneck_is_as_large_as_the_facts_say() -> None:
    with torch.device("meta"):
        net = BottleneckEncoder(NetworkConfig(), STREAMS)
        agent = Agent(NetworkConfig(), merge="vib", streams=STREAMS)
    size = sum(p.numel() for p in net.gaussians["1"].parameters())
    assert round(size / 1e6, 1) == 19.7
    assert agent.actor.trunk.linear.in_features == 9408  # type: ignore[union-attr]


def test_an_update_adds_ten_times_the_cost_to_the_critics_loss() -> None:
    agent, batch = make("vib"), make_batch()
    other, whole = copy.deepcopy(agent), learner(agent, "vib")
    draw = whole.draw(B)
    noise, next_noise = (one.double() for one in draw.merge_noise if one is not None)
    assert not torch.equal(noise, next_noise)
    whole.update(batch, draw)

    now, then = shift(batch.views, draw.shifts[0]), shift(batch.next_views, draw.shifts[1])
    slots = [outputs(other, v, now[:, v]) for v in range(V)]
    following = [outputs(other, v, then[:, v]) for v in range(V)]
    reads = representation(following, next_noise)[None]
    target = td_target(other, reads, batch, draw.target_noise.double())
    row = representation(slots, noise)[None]
    m, s = (torch.cat([x[:, part] for x in slots[1:]]) for part in (slice(L), slice(L, None)))
    cost = 10 * ((m**2 + torch.exp(s) ** 2 - 1) / 2 - s).sum() / (B * 2 * L)
    loss = critic_losses(other, row, batch.state, batch.action, target)[0] + cost
    names, parameters = zip(*other.encoder.named_parameters(), strict=True)
    found = dict(agent.encoder.named_parameters())
    for name, grad in zip(names, torch.autograd.grad(loss, parameters), strict=True):
        torch.testing.assert_close(found[name].grad, grad, rtol=1e-6, atol=1e-9, msg=name)
