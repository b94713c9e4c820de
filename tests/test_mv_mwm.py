"""MV-MWM: its formulas in float64, and what each of its losses reaches."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from madviz.agent.agent import Agent
from madviz.agent.methods import METHODS
from madviz.errors import UserError
from madviz.subsets import every_mask, name_of
from madviz.types import Array
from madviz.world_model.autoencoder import symlog
from madviz.world_model.learner import WorldLearner, drawn_views
from madviz.world_model.mv_mwm_options import MvMwmConfig
from madviz.world_model.rssm import balanced_kl, straight_through
from madviz.world_model.world import (
    FEATURES,
    REWARD,
    STATE,
    Window,
    symexp,
    world_model_losses,
)
from tests.mv_mwm import (
    CLASSES,
    GROUPS,
    MEMORY,
    NETWORKS,
    STREAMS,
    TINY,
    B,
    L,
    T,
    advanced,
    corrected,
    drawn,
    embedded,
    kl,
    make,
    mlp,
    net_of,
    normal,
    policy_of,
    rebuilt,
    seen,
    sigmoid,
    uniform,
)
from tests.test_merges import pictures, softmax, weights

# --- The belief ---------------------------------------------------------------------------------


def test_the_belief_of_every_subset_is_the_formula() -> None:
    agent = make().double().eval()
    w, views = weights(agent.encoder), pictures()
    features = agent.encoder.encode(views)
    assert features.shape == (2, 3, 3, 36, 16)  # B, V, frames, patches, W
    masks = every_mask(3)[:-1]
    rows = agent.encoder.rows(features, torch.from_numpy(masks))
    assert rows.shape == (7, 2, MEMORY + GROUPS * CLASSES)
    for mask, row in zip(masks, rows, strict=True):
        frames = features[1, torch.from_numpy(mask)].detach().numpy()  # (n, frames, 36, W)
        seen_each = [embedded(w, seen(w, frames[:, f].reshape(-1, 16))) for f in range(3)]
        expected = np.concatenate(rebuilt(w, np.stack(seen_each), None))
        np.testing.assert_allclose(row[1].detach().numpy(), expected, rtol=1e-7, atol=1e-7)


def test_a_belief_depends_on_no_absent_camera() -> None:
    agent, views = make(), pictures()[0].numpy()
    policy, state = policy_of(agent), np.zeros(6, np.float32)
    for mask in every_mask(3)[1:-1]:
        other = views.copy()
        other[~mask] = 255 - other[~mask]
        one, two = (policy.read(policy.encode(v, state), mask) for v in (views, other))
        np.testing.assert_array_equal(one.merged, two.merged)
        np.testing.assert_array_equal(one.action, two.action)
        np.testing.assert_array_equal(one.q, two.q)
        other[mask] = 255 - other[mask]
        assert not np.array_equal(policy.read(policy.encode(other, state), mask).merged, one.merged)
    with pytest.raises(UserError, match="at least one stream"):
        policy.read(policy.encode(views, state), np.zeros(3, bool))


def test_a_policy_keeps_nothing_between_decisions() -> None:
    policy, views = policy_of(make()), pictures().numpy()
    state, masks = np.zeros(6, np.float32), every_mask(3)[:-1]
    before = policy.read(policy.encode(views[0], state), masks)
    policy.read(policy.encode(views[1], state), masks)
    after = policy.read(policy.encode(views[0], state), masks)
    np.testing.assert_array_equal(before.action, after.action)


def test_a_policy_imagines_what_is_missing() -> None:
    agent = Agent(NETWORKS, merge="mv-mwm", streams=STREAMS)
    mean = torch.rand(3, 3, 84, 84)
    net_of(agent).autoencoder.mean.copy_(mean)
    policy = policy_of(agent)
    found = policy.imagine(
        policy.encode(pictures()[0].numpy(), np.zeros(6, np.float32)), np.array([True, False, True])
    )
    expected = (255 * mean).round().byte().permute(0, 2, 3, 1).numpy()
    np.testing.assert_array_equal(found, expected)  # Nothing is learned: the mean.


def test_what_is_imagined_is_of_the_newest_frame() -> None:
    agent, views, mask = make().eval(), pictures(), torch.tensor([True, False, True])
    net, older, newer = net_of(agent), views.clone(), views.clone()
    older[:, :, :6] = 255 - older[:, :, :6]
    newer[:, :, 6:] = 255 - newer[:, :, 6:]
    one, two, three = (net.imagined(net.encode(v), mask) for v in (views, older, newer))
    assert torch.equal(one, two) and not torch.equal(one, three)


# --- The world model's losses -------------------------------------------------------------------


def test_symlog_and_back() -> None:
    x = np.array([-100.0, -1.5, 0.0, 0.3, 40.0])
    there = np.sign(x) * np.log(1 + np.abs(x))
    np.testing.assert_allclose(symlog(torch.from_numpy(x)).numpy(), there, rtol=1e-12)
    np.testing.assert_allclose(symexp(torch.from_numpy(there)).numpy(), x, rtol=1e-12)


def test_a_draw_is_one_hot_and_its_gradient_that_of_the_probabilities() -> None:
    logits, noise, slope = normal(5, 3).requires_grad_(), uniform(5), normal(5, 3, seed=4)
    values = straight_through(logits, noise)
    (values * slope).sum().backward()
    assert logits.grad is not None
    for row, u, value, s, grad in zip(
        logits.detach().numpy(), noise.numpy(), values.detach().numpy(), slope.numpy(),
        logits.grad.numpy(), strict=True,
    ):  # fmt: skip
        p = softmax(row)
        index = int(u >= p[0]) + int(u >= p[0] + p[1])
        np.testing.assert_allclose(value, np.eye(3)[index], atol=1e-12)
        np.testing.assert_allclose(grad, (np.diag(p) - np.outer(p, p)) @ s, rtol=1e-9)
    likeliest = straight_through(logits, None).detach()
    assert torch.equal(likeliest.argmax(-1), logits.argmax(-1))
    share = straight_through(torch.tensor([0.7, 0.3]).log().expand(4000, 2), uniform(4000)).mean(0)
    np.testing.assert_allclose(share.numpy(), [0.7, 0.3], atol=0.03)


def test_the_example_at_the_top_of_the_rssm() -> None:
    logits = torch.tensor([0.7, 0.3]).log().requires_grad_()
    (straight_through(logits, torch.tensor(0.1)) * torch.tensor([2.0, 0.0])).sum().backward()
    assert logits.grad is not None
    np.testing.assert_allclose(logits.grad.numpy(), [0.42, -0.42], rtol=1e-5)


def test_the_balanced_kl_moves_the_prior_faster_and_has_free_nats() -> None:
    posterior, prior = normal(B, GROUPS, CLASSES), normal(B, GROUPS, CLASSES, seed=5)
    expected = np.mean([kl(q, p) for q, p in zip(posterior.numpy(), prior.numpy(), strict=True)])
    for one in (posterior, prior):
        one.requires_grad_()
    found = balanced_kl(posterior, prior, 0.8, 0.1)
    assert found.item() == pytest.approx(expected) and expected > 0.1
    found.backward()
    assert posterior.grad is not None and prior.grad is not None
    q, p = (torch.softmax(one, -1).detach().numpy() for one in (posterior, prior))
    np.testing.assert_allclose(prior.grad.numpy(), 0.8 * (p - q) / B, rtol=1e-9, atol=1e-12)
    away = np.log(q / p)
    slope = q * (away - (q * away).sum(-1, keepdims=True))
    np.testing.assert_allclose(posterior.grad.numpy(), 0.2 * slope / B, rtol=1e-8, atol=1e-12)
    near = (posterior.detach() + 0.01 * prior.detach()).requires_grad_()
    little = balanced_kl(posterior.detach(), near, 0.8, 0.1)
    little.backward()
    assert little.item() == pytest.approx(0.1) and near.grad is not None and not near.grad.any()


def window(agent: Agent) -> Window:
    embedding = 8 * TINY.own.world_model.reader_width
    return Window(
        present=normal(T, B, embedding),
        features=normal(L + 1, B, 108, 16, seed=3),
        state=normal(L + 1, B, 6, seed=4),
        action=uniform(L, B, 2, seed=5),
        reward=10 * normal(L, B, seed=6),
        follows=(uniform(L, B, seed=7) > 0.4).double(),
    )


def test_the_world_models_losses_are_the_formula() -> None:
    agent = make().double()
    seen_there, noise = window(agent), uniform(T + L, B, GROUPS)
    found = world_model_losses(net_of(agent).world, seen_there, noise, kl_weight=3.0)
    w, numbers = weights(agent.encoder), {k: v.numpy() for k, v in vars(seen_there).items()}
    terms: dict[str, list[float]] = {name: [] for name in found}
    weight = {"features": FEATURES, "reward": REWARD, "state": STATE, "follows": 1, "kl": 3.0}
    weight["ahead"] = 1

    def errors(belief: Array, step: int, b: int) -> dict[str, float]:
        """Of what one belief predicts; of what came before the first one, nothing is asked."""
        state = numbers["state"][step, b]
        features = mlp(w, "world.features", belief) - numbers["features"][step, b].ravel()
        felt = mlp(w, "world.state", belief) - np.sign(state) * np.log1p(np.abs(state))
        wrong = {"features": 0.5 * (features**2).sum() / 108, "state": 0.5 * (felt**2).sum()}
        if step:
            reward, goes_on = (numbers[k][step - 1, b] for k in ("reward", "follows"))
            error = mlp(w, "world.reward", belief) - np.sign(reward) * np.log1p(abs(reward))
            likely = sigmoid(mlp(w, "world.follows", belief)[0])
            wrong["reward"] = 0.5 * float(error[0]) ** 2
            wrong["follows"] = -math.log(likely if goes_on else 1 - likely)
        return wrong

    for b in range(B):
        stack = T - L
        start = noise[:stack, b].numpy()
        memory, latent = first = rebuilt(w, numbers["present"][:stack, b], start)
        for step in range(L + 1):
            belief = np.concatenate([memory, latent])
            for name, error in errors(belief, step, b).items():
                terms[name].append(error)
            if step < L:
                memory = advanced(w, memory, latent, numbers["action"][step, b])
                guess = mlp(w, "world.rssm.prior", memory)
                logits = corrected(w, memory, numbers["present"][stack + step, b])
                terms["kl"].append(kl(logits, guess))
                latent = drawn(logits, noise[stack + step, b].numpy())
        memory, latent = first
        for step in range(L):  # Without the pictures.
            memory = advanced(w, memory, latent, numbers["action"][step, b])
            latent = drawn(mlp(w, "world.rssm.prior", memory), noise[T + step, b].numpy())
            wrong = errors(np.concatenate([memory, latent]), step + 1, b)
            terms["ahead"].append(sum(weight[name] * error for name, error in wrong.items()))
    expected = {name: weight[name] * np.mean(rows) for name, rows in terms.items()}
    assert {k: v.item() for k, v in found.items()} == pytest.approx(expected, rel=1e-8)


def test_a_window_without_actions_is_refused() -> None:
    agent = make().double()
    empty = replace(window(agent), action=torch.zeros(0, B, 2))
    with pytest.raises(ValueError, match="with actions"):
        world_model_losses(net_of(agent).world, empty, uniform(T, B, GROUPS), 1.0)


@pytest.mark.parametrize("views", [1, 2, 5])
def test_views_are_dropped_uniformly(views: int) -> None:
    present = drawn_views(torch.Generator().manual_seed(0), 6000, views)
    counts = torch.bincount(present.sum(1), minlength=views + 1)[1:] / 6000
    np.testing.assert_allclose(counts.numpy(), np.full(views, 1 / views), atol=0.03)
    expected = (1 + views) / 2 / views
    np.testing.assert_allclose(present.float().mean(0).numpy(), expected, atol=0.03)


def test_a_sample_is_read_from_its_present_views_alone() -> None:
    """In a batch of several subsets, each row is what its own tokens give."""
    agent = make().double()
    learner, w = WorldLearner(agent, MvMwmConfig(), 0.9), weights(agent.encoder)
    tokens = normal(2, 4, 3, 36, 16)
    present = torch.tensor([[1, 0, 1], [0, 1, 0], [1, 1, 1], [1, 1, 0]]).bool()
    with pytest.MonkeyPatch.context() as patch:
        off = torch.autocast("cpu", enabled=False)
        patch.setattr("madviz.world_model.learner.autocast", lambda: off)
        patch.setattr(Tensor, "float", lambda self: self)
        found = learner._embedded(tokens, present)
    for t in range(2):
        for b in range(4):
            own = tokens[t, b, present[b]].flatten(0, 1).numpy()
            expected = embedded(w, seen(w, own))
            np.testing.assert_allclose(found[t, b].detach().numpy(), expected, rtol=1e-7)


# --- The table ----------------------------------------------------------------------------------


def test_the_method_trains_every_subset_and_has_one_recipe() -> None:
    row = METHODS["mv-mwm"]
    assert row.recipes == ("mv-mwm",) and row.merge == "mv-mwm"
    expected = {name_of(mask, STREAMS) for mask in every_mask(3)[:-1]}
    assert set(row.trained_subsets(STREAMS)) == expected and len(expected) == 7
    assert "mv-mwm" not in METHODS["mv-mae"].recipes
