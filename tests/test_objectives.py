"""MAD's update against a second computation of it, written from the paper in float64 loops."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks.naive import NaiveLearner
from madviz.agent import update
from madviz.agent.agent import Agent
from madviz.agent.methods import METHODS, method
from madviz.agent.networks import NetworkConfig
from madviz.agent.objectives import (
    Batch,
    actor_losses,
    critic_losses,
    td_target,
    temperature_losses,
    weighted,
)
from madviz.agent.update import Draw, Learner, LearningConfig
from madviz.envs.registry import setting
from madviz.errors import UserError

Params = dict[str, Tensor]
NETWORKS = NetworkConfig(state_dim=5, action_dim=2, hidden_dim=16)
STREAMS = {name: setting(name).streams for name in ("three", "three-rgbd")}
LR, TAU, ALPHA, B = 5e-4, 0.01, 0.8, 3


# --- The paper again, one sample and one row at a time ---------------------------------------


def paper_cnn(p: Params, image: Tensor, shift: tuple[int, int]) -> Tensor:
    """f(o): uint8 (C, 84, 84) -> (3136,)."""
    index = torch.arange(84)
    rows, columns = (index + shift[0]).clamp(0, 83), (index + shift[1]).clamp(0, 83)
    x = image.double()[None, :, rows][..., columns] / 255 - 0.5
    for name, stride in (("conv1", 4), ("conv2", 2), ("conv3", 1)):
        weight, bias = p[f"encoder.{name}.weight"], p[f"encoder.{name}.bias"]
        x = F.conv2d(x, weight, bias, stride=stride).clamp(min=0)
    return x.reshape(-1)


def paper_trunk(p: Params, head: str, feature: Tensor) -> Tensor:
    h = p[f"{head}.trunk.linear.weight"] @ feature + p[f"{head}.trunk.linear.bias"]
    h = (h - h.mean()) / torch.sqrt(((h - h.mean()) ** 2).mean() + 1e-5)
    return torch.tanh(h * p[f"{head}.trunk.norm.weight"] + p[f"{head}.trunk.norm.bias"])


def paper_mlp(p: Params, name: str, x: Tensor) -> Tensor:
    for layer in (0, 2):
        x = (p[f"{name}.{layer}.weight"] @ x + p[f"{name}.{layer}.bias"]).clamp(min=0)
    return p[f"{name}.4.weight"] @ x + p[f"{name}.4.bias"]


def paper_policy(p: Params, feature: Tensor, state: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    out = paper_mlp(p, "actor.mlp", torch.cat([state, paper_trunk(p, "actor", feature)]))
    mean, raw = out[: len(noise)], out[len(noise) :]
    std = torch.exp(-10 + 6 * (torch.tanh(raw) + 1))
    x = mean + std * noise
    density = torch.exp(-(((x - mean) / std) ** 2) / 2) / (std * math.sqrt(2 * math.pi))
    return torch.tanh(x), (torch.log(density) - torch.log(1 - torch.tanh(x) ** 2)).sum()


def paper_q(p: Params, critic: str, feature: Tensor, state: Tensor, action: Tensor) -> list[Tensor]:
    x = torch.cat([paper_trunk(p, critic, feature), action, state])
    return [paper_mlp(p, f"{critic}.{q}", x)[0] for q in ("q1", "q2")]


@dataclass(frozen=True)
class Rows:
    """What one sample is read as: the masks, the share of each, and who teaches it."""

    masks: np.ndarray
    shares: Sequence[float]
    own: bool = False
    """Targets and the actor's Q come from the row's own feature, not from the merged one."""


def mad_rows(streams: tuple[str, ...]) -> Rows:
    masks = METHODS["mad"].masks(streams)
    singular = len(masks) - 1
    return Rows(masks, [ALPHA] + [(1 - ALPHA) / singular] * singular)


def paper_losses(
    p: Params, updated: Params | None, batch: Batch, draw: Draw, rows: Rows
) -> dict[str, Tensor]:
    """Critic, actor and temperature losses; the actor is judged by the ``updated`` critic."""
    critic = actor = temperature = torch.zeros((), dtype=torch.float64)
    temp = torch.exp(p["log_temperature"])
    for b in range(len(batch.action)):
        views, follow = (
            [paper_cnn(p, images[b, v], tuple(shifts[b, v])) for v in range(images.shape[1])]
            for images, shifts in zip((batch.views, batch.next_views), draw.shifts, strict=True)
        )
        state, next_state = batch.state[b].double(), batch.next_state[b].double()
        for row, mask in enumerate(rows.masks):
            feature, following = (
                torch.stack([v for v, on in zip(features, mask, strict=True) if on]).sum(0)
                for features in (views, follow)
            )
            judge, teacher = feature, following
            if not rows.own:
                judge, teacher = torch.stack(views).sum(0), torch.stack(follow).sum(0)
            noise = draw.target_noise[row if rows.own else 0, b].double()
            a, log_prob = paper_policy(p, teacher, next_state, noise)
            q = min(paper_q(p, "target", teacher, next_state, a))
            y = (batch.reward[b] + batch.discount[b] * (q - temp * log_prob)).detach()
            weight = rows.shares[row] / len(batch.action)
            for q in paper_q(p, "critic", feature, state, batch.action[b].double()):
                critic = critic + weight * (q - y) ** 2
            a, log_prob = paper_policy(p, feature, state, draw.actor_noise[row, b].double())
            q = min(paper_q(updated or p, "critic", judge, state, a))
            actor = actor + weight * (temp.detach() * log_prob - q)
            target_entropy = -len(a)
            temperature = temperature + weight * temp * (-log_prob.detach() - target_entropy)
    return {"critic": critic, "actor": actor, "temperature": temperature}


def paper_update(agent: Agent, batch: Batch, draw: Draw, rows: Rows) -> Params:
    """All weights after one update by Adam from rest; gradients are kept as ``grad:name``."""
    p = {name: t.detach().double().requires_grad_() for name, t in agent.state_dict().items()}
    trained: dict[str, tuple[str, ...]] = {
        "critic": ("encoder.", "critic."), "actor": ("actor.",), "temperature": ("log_",),
    }  # fmt: skip
    new, updated = dict(p), None
    for loss, prefixes in trained.items():
        value = paper_losses(p, updated, batch, draw, rows)[loss]
        names = [name for name in p if name.startswith(prefixes)]
        for name, grad in zip(
            names, torch.autograd.grad(value, [p[n] for n in names]), strict=True
        ):
            new["grad:" + name] = grad
            new[name] = p[name].detach() - LR * grad / (grad.abs() + 1e-8)
        if loss == "critic":
            updated = {name: t.detach() for name, t in new.items()}
    for name in [name for name in p if name.startswith("target.")]:
        new[name] = 0.99 * p[name] + 0.01 * new[name.replace("target.", "critic.")]
    return {name: t.detach() for name, t in new.items()}


# --- Fixtures --------------------------------------------------------------------------------


def make_agent(seed: int = 0) -> Agent:
    torch.manual_seed(seed)
    agent = Agent(NETWORKS)
    with torch.no_grad():
        for name, parameter in agent.named_parameters():
            # Fresh biases are zero and the target equals the critic; both would hide mistakes.
            if name.endswith("bias") or name.startswith("target."):
                parameter.add_(0.1 * torch.randn_like(parameter))
    return agent.double()


def make_batch(streams: int, seed: int = 0, size: int = B) -> Batch:
    rng = np.random.default_rng(seed)

    def images() -> Tensor:
        return torch.from_numpy(rng.integers(0, 256, (size, streams, 9, 84, 84), np.uint8))

    def numbers(*shape: int) -> Tensor:
        return torch.from_numpy(rng.standard_normal((size, *shape)).astype(np.float32))

    discount = torch.full((size,), 0.99)
    discount[0] = 0
    return Batch(images(), numbers(5), numbers(2).tanh(), numbers(), discount, images(), numbers(5))


def make_learner(agent: Agent, name: str, streams: tuple[str, ...], **config: object) -> Learner:
    settings = {"precision": "float32", "same_shift_for_views": False, **config}
    return Learner(agent, METHODS[name], streams, LearningConfig(**settings), seed=3)  # type: ignore[arg-type]


def assert_as_in_paper(found: Agent, expected: Params) -> None:
    for name, parameter in found.named_parameters():
        if not name.startswith("target."):
            assert parameter.grad is not None, name
            torch.testing.assert_close(
                parameter.grad, expected["grad:" + name], rtol=1e-6, atol=1e-9, msg=name
            )
        # Adam's first step is 5e-4 whatever the gradient; where that is almost 0, so is its sign.
        torch.testing.assert_close(parameter, expected[name], rtol=1e-6, atol=1e-7, msg=name)


@pytest.mark.parametrize(("name", "row"), [("mad", 0), ("singular-only", 1)])
def test_the_entropy_is_that_of_a_trained_row(
    name: str, row: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Tensor] = []

    def losses(*args: Any) -> tuple[Tensor, Tensor]:
        found = actor_losses(*args)
        drawn.append(found[1].detach().clone())
        return found

    monkeypatch.setattr(update, "actor_losses", losses)
    learner = make_learner(make_agent().float(), name, STREAMS["three"])
    entropy = learner.update(make_batch(3))["entropy"]
    assert entropy == pytest.approx(-drawn[0][row].mean().item())


# --- One full update -------------------------------------------------------------------------


@pytest.mark.parametrize("setting_name", ["three", "three-rgbd"])
def test_an_update_of_mad_is_the_papers(setting_name: str) -> None:
    streams = STREAMS[setting_name]
    agent, batch = make_agent(), make_batch(len(streams))
    learner = make_learner(agent, "mad", streams)
    draw = learner.draw(B)
    expected = paper_update(agent, batch, draw, mad_rows(streams))
    metrics = learner.update(batch, draw)
    assert_as_in_paper(agent, expected)
    assert metrics["temperature"] == pytest.approx(expected["log_temperature"].exp().item())


@pytest.mark.parametrize(
    ("name", "shares"),
    [("naive-both", [1 / 4] * 4), ("singular-only", [0, 1 / 3, 1 / 3, 1 / 3])],
)
def test_without_the_rule_every_row_is_its_own_teacher(name: str, shares: list[float]) -> None:
    streams = STREAMS["three"]
    agent, batch = make_agent(), make_batch(3)
    learner = make_learner(agent, name, streams)
    draw = learner.draw(B)
    assert draw.target_noise.shape == (4, B, 2)
    expected = paper_update(
        agent, batch, draw, Rows(METHODS[name].masks(streams), shares, own=True)
    )
    learner.update(batch, draw)
    assert_as_in_paper(agent, expected)


def test_a_method_without_a_merged_term_explores_on_one_stream_and_mad_on_all() -> None:
    batch, seen = make_batch(3), {}
    for name, alpha in (("mad", 0.8), ("singular-only", 0.8), ("mad", 0.0)):
        agent = make_agent().float()
        learner = make_learner(agent, name, STREAMS["three"], alpha=alpha)
        read: list[Tensor] = []
        agent.actor.register_forward_hook(lambda _, inputs, __, read=read: read.append(inputs[0]))
        for _ in range(12):
            learner.act_all(batch.views[:1], batch.state[:1])
        features = agent.encoder.encode(batch.views[:1])[0]
        rows = [features.sum(0), *features]
        near = [[torch.allclose(x[0], row, rtol=1e-4, atol=1e-5) for row in rows] for x in read]
        seen[name, alpha] = np.array(near).sum(0)
    assert list(seen.pop(("mad", 0.8))) == [12, 0, 0, 0]
    for name, counts in seen.items():
        assert counts[0] == 0 and (counts[1:] > 0).all() and counts.sum() == 12, name


def test_the_naive_learner_passes_the_same_test() -> None:
    streams = STREAMS["three"]
    agent, batch = make_agent(), make_batch(3)
    draw = make_learner(agent, "mad", streams).draw(B)
    expected = paper_update(agent, batch, draw, mad_rows(streams))
    naive = NaiveLearner(agent)
    naive.update(batch, draw)
    assert_as_in_paper(naive.agent, expected)


def test_bfloat16_points_the_same_way() -> None:
    streams, batch = STREAMS["three"], make_batch(3, size=16)
    exact, low = make_agent().float(), make_agent().float()
    draw = make_learner(exact, "mad", streams).draw(16)
    make_learner(exact, "mad", streams).update(batch, draw)
    make_learner(low, "mad", streams, precision="bfloat16").update(batch, draw)
    for part in ("encoder", "actor", "critic"):
        a, b = (
            torch.cat([p.grad.flatten() for p in getattr(agent, part).parameters()])
            for agent in (exact, low)
        )
        assert F.cosine_similarity(a, b, dim=0) > 0.98, part
        assert not torch.equal(a, b), "autocast did nothing"


def test_merged_only_is_mad_with_alpha_one() -> None:
    streams, batch = STREAMS["three"], make_batch(3)
    both = [make_agent(), make_agent()]
    mad = make_learner(both[0], "mad", streams, alpha=1.0)
    merged = make_learner(both[1], "merged-only", streams)
    draw = mad.draw(B)
    mad.update(batch, draw)
    merged.update(batch, Draw(draw.shifts, draw.target_noise, draw.actor_noise[:1]))
    for (name, a), b in zip(both[0].named_parameters(), both[1].parameters(), strict=True):
        torch.testing.assert_close(a, b, msg=name)


def test_the_shift_is_the_same_for_all_views_only_if_asked() -> None:
    agent, streams = make_agent(), STREAMS["three"]
    alike = make_learner(agent, "mad", streams, same_shift_for_views=True).draw(64).shifts
    apart = make_learner(agent, "mad", streams, same_shift_for_views=False).draw(64).shifts
    assert alike.shape == apart.shape == (2, 64, 3, 2)
    assert (alike == alike[:, :, :1]).all() and not (apart == apart[:, :, :1]).all()
    assert not (alike[0] == alike[1]).all(), "next observations are shifted on their own"
    assert LearningConfig().same_shift_for_views


# --- Who learns from what --------------------------------------------------------------------


def rows_of(agent: Agent, batch: Batch) -> Tensor:
    masks = torch.from_numpy(METHODS["mad"].masks(STREAMS["three"])).double()
    return torch.einsum("nv,bvz->nbz", masks, agent.encoder.encode(batch.views))


def reached(agent: Agent) -> set[str]:
    """The networks that have a gradient."""
    found = [name for name, p in agent.named_parameters() if p.grad is not None]
    return {name.split(".")[0] for name in found}


def test_gradients_go_where_the_paper_says() -> None:
    agent, batch = make_agent(), make_batch(3)
    noise = torch.zeros(4, B, 2, dtype=torch.float64)
    rows = rows_of(agent, batch)
    target = td_target(agent, rows[:1], batch, noise[:1])
    assert not target.requires_grad
    critic_losses(agent, rows, batch.state, batch.action, target).sum().backward()
    assert reached(agent) == {"encoder", "critic"}
    agent.zero_grad()
    losses, log_prob = actor_losses(agent, rows, batch, noise, rows[:1])
    losses.sum().backward()
    assert reached(agent) == {"actor", "critic"}, "the critic's are dropped by the step below"
    agent.zero_grad()
    temperature_losses(agent, log_prob).sum().backward()
    assert reached(agent) == {"log_temperature"}


def test_a_step_asks_only_for_the_gradients_it_uses() -> None:
    agent, batch = make_agent(), make_batch(3)
    rows = rows_of(agent, batch).detach()
    noise = torch.zeros(4, B, 2, dtype=torch.float64)
    before = {n: p.detach().clone() for n, p in agent.named_parameters()}
    losses, _ = actor_losses(agent, rows, batch, noise, rows[:1])
    make_learner(agent, "mad", STREAMS["three"])._step(losses.sum(), "actor")
    moved = {n.split(".")[0] for n, p in agent.named_parameters() if not torch.equal(p, before[n])}
    assert moved == reached(agent) == {"actor"}


def test_targets_and_the_actors_q_are_read_on_the_merged_feature_alone() -> None:
    agent, batch = make_agent(), make_batch(3)
    learner = make_learner(agent, "mad", STREAMS["three"])
    draw = learner.draw(B)
    still = replace(draw, shifts=np.zeros_like(draw.shifts))
    rows = rows_of(agent, batch).detach()
    following = rows_of(agent, replace(batch, views=batch.next_views)).detach()
    read: dict[str, list[Tensor]] = {"target": [], "critic": []}
    for name, seen in read.items():
        trunk = getattr(agent, name).trunk
        trunk.register_forward_hook(lambda _, inputs, __, seen=seen: seen.append(inputs[0]))
    learner.update(batch, still)
    (target,), (critic, actor) = read["target"], read["critic"]
    torch.testing.assert_close(target, following[:1])
    torch.testing.assert_close(critic, rows)
    torch.testing.assert_close(actor, rows[:1])


def test_the_target_discounts_by_the_stored_discount() -> None:
    agent, batch = make_agent(), make_batch(3)
    rows = rows_of(agent, batch).detach()
    y = td_target(agent, rows[:1], batch, torch.zeros(1, B, 2, dtype=torch.float64))
    assert y[0, 0] == batch.reward[0], "a discount of 0 leaves the reward"
    assert y[0, 1] != batch.reward[1]


# --- Methods ---------------------------------------------------------------------------------


def test_the_objective_is_the_weighted_sum_of_its_terms() -> None:
    losses = torch.tensor([1.0, 2.0, 4.0, 6.0])
    assert weighted(losses, METHODS["mad"].weights(0.8)).item() == pytest.approx(0.8 + 0.2 * 4)
    assert weighted(losses, METHODS["merged-only"].weights(0.8)).item() == 1
    assert weighted(losses, METHODS["singular-only"].weights(0.8)).item() == 4
    assert weighted(losses, METHODS["naive-both"].weights(0.8)).item() == 13 / 4
    assert weighted(losses, METHODS["mad"].weights(0.5)).item() == 2.5, "SADA's weighting"
    rows = METHODS["mad"].row_weights(STREAMS["three"], 0.8)
    np.testing.assert_allclose(rows, [0.8, 0.2 / 3, 0.2 / 3, 0.2 / 3], rtol=1e-6)
    rows = METHODS["naive-both"].row_weights(STREAMS["three"], 0.8)
    np.testing.assert_allclose(rows, [1 / 4] * 4, rtol=1e-6)
    rows = METHODS["singular-only"].row_weights(STREAMS["three"], 0.8)
    np.testing.assert_allclose(rows, [0, 1 / 3, 1 / 3, 1 / 3], rtol=1e-6)


def test_methods_say_what_they_train_on() -> None:
    assert METHODS["mad"].trained_subsets(STREAMS["three"]) == ("all", *STREAMS["three"])
    assert METHODS["merged-only"].trained_subsets(STREAMS["three"]) == ("all",)
    assert METHODS["singular-only"].trained_subsets(STREAMS["three"]) == STREAMS["three"]
    assert METHODS["mvd"].trained_subsets(STREAMS["three"]) == ("all", *STREAMS["three"])
    assert METHODS["vib"].trained_subsets(STREAMS["three"]) == ("all",)
    rgbd = METHODS["mad"].trained_subsets(STREAMS["three-rgbd"])
    assert {"all", "rgb", "depth", "first", "third_a.depth"} <= set(rgbd) and len(rgbd) == 12


def test_unfit_methods_are_refused_in_words() -> None:
    with pytest.raises(UserError, match="unknown method 'made'; did you mean mad.* known: .*mad, "):
        method("made")
    with pytest.raises(UserError, match="2 or more streams, found 1"):
        METHODS["mad"].masks(("first",))
