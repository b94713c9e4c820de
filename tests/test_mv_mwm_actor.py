"""MV-MWM's actor and critic: what is imagined, in float64, and what they learn from it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from madviz.world_model.actor_critic import (
    BeliefActor,
    imagine,
    imagined_actor_loss,
    imagined_critic_loss,
    lambda_returns,
    reached,
    truncated_normal,
)
from tests.mv_mwm import (
    GROUPS,
    B,
    advanced,
    believed,
    drawn,
    make,
    mlp,
    net_of,
    normal,
    sigmoid,
    uniform,
)
from tests.test_merges import weights


def test_lambda_returns_are_the_mixture_of_all_shorter_returns() -> None:
    reward, value = normal(5, B).numpy(), normal(5, B, seed=3).numpy()
    discount, mixture = uniform(5, B).numpy(), 0.95
    given = [torch.from_numpy(x) for x in (reward, discount, value)]
    found = lambda_returns(given[0], given[1], given[2], mixture).numpy()
    for k in range(5):
        shorter = []
        for end in range(k, 5):  # Rewards up to ``end``, then the value of where that leads.
            total, weight = np.zeros(B), np.ones(B)
            for j in range(k, end + 1):
                total += weight * reward[j]
                weight = weight * discount[j]
            shorter.append(total + weight * value[end])
        shares = [(1 - mixture) * mixture**n for n in range(len(shorter) - 1)]
        shares.append(mixture ** (len(shorter) - 1))
        mixed = sum(share * one for share, one in zip(shares, shorter, strict=True))
        np.testing.assert_allclose(found[k], mixed, rtol=1e-10)
    example = lambda_returns(
        torch.ones(2, 1), torch.full((2, 1), 0.9), torch.full((2, 1), 5.0), 0.95
    )
    np.testing.assert_allclose(example[:, 0].numpy(), [5.9275, 5.5], rtol=1e-6)


def test_actions_are_a_truncated_normals() -> None:
    middle, spread = np.array([[-0.9, 0.2], [0.0, 0.99]]), np.array([[0.1, 1.5], [2.0, 0.3]])
    noise = uniform(2, 2)
    action, entropy = truncated_normal(torch.from_numpy(middle), torch.from_numpy(spread), noise)
    real = stats.truncnorm((-1 - middle) / spread, (1 - middle) / spread, middle, spread)
    np.testing.assert_allclose(action.numpy(), real.ppf(noise.numpy()), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(entropy.numpy(), real.entropy().sum(-1), rtol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 1 - 1e-7])
def test_actions_at_the_edges_have_finite_gradients(noise: float) -> None:
    middle = torch.tensor([[-0.999, 0.999, 0.0]], requires_grad=True)
    spread = torch.tensor([[0.1, 0.1, 2.1]], requires_grad=True)
    action, entropy = truncated_normal(middle, spread, torch.full((1, 3), noise))
    (action.sum() + entropy.sum()).backward()
    assert middle.grad is not None and spread.grad is not None
    assert (
        (action.abs() <= 1).all() and middle.grad.isfinite().all() and spread.grad.isfinite().all()
    )


def test_an_imagination_is_the_formula_and_weighs_by_what_follows() -> None:
    agent = make().double()
    assert isinstance(agent.actor, BeliefActor)
    start, state = believed(agent), normal(B, 6)
    noise = (uniform(2, B, 2), uniform(2, B, GROUPS, seed=8))
    imagined = imagine(net_of(agent).world, agent.actor, start, state, noise, gamma=0.9)
    w, actor = weights(agent.encoder), weights(agent.actor)
    memory, latent, known = (
        start.deterministic[1].numpy(),
        start.latent[1].flatten().numpy(),
        state[1],
    )
    for step in range(2):
        belief = np.concatenate([memory, latent])
        middle, raw = np.split(mlp(actor, "mlp", np.concatenate([belief, known])), 2)
        middle, spread = np.tanh(middle), 2 * sigmoid(raw / 2) + 0.1
        edges = (-1 - middle) / spread, (1 - middle) / spread
        choice = stats.truncnorm(*edges, middle, spread)
        action = choice.ppf(noise[0][step, 1].numpy())
        assert imagined.entropy[step, 1].item() == pytest.approx(choice.entropy().sum(), rel=1e-6)
        memory = advanced(w, memory, latent, action)
        latent = drawn(mlp(w, "world.rssm.prior", memory), noise[1][step, 1].numpy())
        belief = np.concatenate([memory, latent])
        reward, known = mlp(w, "world.reward", belief)[0], mlp(w, "world.state", belief)
        reward, known = (np.sign(x) * np.expm1(np.abs(x)) for x in (reward, known))
        follows = 0.9 * sigmoid(mlp(w, "world.follows", belief)[0])
        assert imagined.reward[step, 1].item() == pytest.approx(reward, rel=1e-4)
        assert imagined.discount[step, 1].item() == pytest.approx(follows, rel=1e-4)
        found = imagined.state[step + 1, 1].detach().numpy()
        np.testing.assert_allclose(found, known, rtol=1e-4)
    expected = torch.stack([torch.ones(B), imagined.discount[0].detach()])
    torch.testing.assert_close(reached(imagined.discount), expected, check_dtype=False)


def test_the_losses_of_actor_and_critic() -> None:
    returns, entropy, weight = normal(2, B), normal(2, B, seed=3), uniform(2, B)
    value = normal(2, B, seed=4)
    numbers = [x.numpy() for x in (returns, entropy, weight, value)]
    g, h, w, v = numbers
    found = imagined_actor_loss(returns, entropy, weight, 0.01).item()
    assert found == pytest.approx(-(w * (g + 0.01 * h)).mean())
    critic = imagined_critic_loss(value, returns.requires_grad_(), weight)
    assert critic.item() == pytest.approx(0.5 * (w * (v - g) ** 2).mean())
    assert not critic.requires_grad, "returns are data to the critic"


def test_rewards_reach_actions_through_the_world_model() -> None:
    agent = make().double()
    assert isinstance(agent.actor, BeliefActor)
    noise = (uniform(3, B, 2), uniform(3, B, GROUPS, seed=8))
    imagined = imagine(net_of(agent).world, agent.actor, believed(agent), normal(B, 6), noise, 0.9)
    imagined.reward[-1].sum().backward()
    slopes = [p.grad for p in agent.actor.parameters()]
    assert all(slope is not None and slope.any() for slope in slopes)
