"""One update of the light recipe against a second computation of it in float64, and its parts that
are off by default."""

from __future__ import annotations

import copy
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from madviz.agent.agent import Agent
from madviz.agent.networks import Actor, ActorHead, NetworkConfig, read_state
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.runs.demonstrations import Driver, record_episode
from madviz.training import light
from madviz.training.config import TrainConfig
from madviz.training.light import LightConfig, LightRun
from madviz.training.light_losses import check_places, choice_errors, mean_and_std
from madviz.training.train import train
from madviz.types import Environment, TimeStep
from tests.plans import THREE, toy_plan

BASE = LightConfig(
    rounds=4, demonstrations=2, episodes_per_round=1, updates_per_round=3, batch_size=5,
    alpha=0.7, shift=0, learning_rate=1.0,
)  # fmt: skip
HALF_WAY = 6
"""Updates of twelve."""


@pytest.fixture(autouse=True)
def in_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(light, "autocast", nullcontext)


def recorded(
    folder: Path, config: LightConfig = BASE, method: str = "mad", **plan: Any
) -> LightRun:
    """A run with two episodes, in which what was done is not what the expert would have done, and
    plain gradient steps in place of Adam's: those show the gradient."""
    run = LightRun(toy_plan(method), config, folder)
    run.add([record_episode(ToyReach(), THREE, Driver(1.0, 0.6), seed) for seed in (1, 2)], 0, [])
    learned = [p for g in run.optimisers["optimiser"].param_groups for p in g["params"]]
    run.optimisers["optimiser"] = torch.optim.SGD(learned)  # type: ignore[assignment]
    return run


def decisions(run: LightRun) -> np.ndarray:
    """Those of the next update."""
    rng = copy.deepcopy(run.rng)
    return rng.integers(0, len(run.data), run.config.batch_size)


def exact_rows(agent: Agent, views: Tensor) -> list[Tensor]:
    """The merged feature and every single one, (B, Z) in float64."""
    single = [agent.encoder(views[:, v]) for v in range(views.shape[1])]
    return [torch.stack(single).sum(0), *single]


@pytest.mark.parametrize(("average", "kept"), [(0.998, 7 / 16), (0.3, 0.3)])
def test_an_update_is_the_weighted_imitation_of_the_expert(
    tmp_path: Path, average: float, kept: float
) -> None:
    run = recorded(tmp_path, replace(BASE, average=average))
    run.updates, index = HALF_WAY, decisions(run)
    agent, slow = copy.deepcopy(run.agent).double(), copy.deepcopy(run.average)
    found = run.update()

    views = run.data.views(index)
    state, label = (run.data.column(name, index).double() for name in ("states", "labels"))
    errors = [
        (torch.tanh(agent.actor(row, state)[0]) - label).square().mean()
        for row in exact_rows(agent, views)
    ]
    loss = 0.7 * errors[0] + 0.3 * (errors[1] + errors[2] + errors[3]) / 3
    assert found == pytest.approx(loss.item(), rel=1e-5)
    loss.backward()
    fast, averaged = dict(run.agent.named_parameters()), dict(run.average.named_parameters())
    moved = 0
    for (name, before), behind in zip(agent.named_parameters(), slow.parameters(), strict=True):
        step = 0 if before.grad is None else 0.5 * before.grad  # Half of the rate is left.
        expected = (before - step).detach()
        moved += not torch.equal(expected, before.detach())
        torch.testing.assert_close(fast[name].double(), expected, rtol=1e-4, atol=1e-6, msg=name)
        mixed = kept * behind.double() + (1 - kept) * expected
        torch.testing.assert_close(averaged[name].double(), mixed, rtol=1e-4, atol=1e-6, msg=name)
    assert moved > 10


def test_the_learning_rate_falls_to_its_floor_over_all_rounds(tmp_path: Path) -> None:
    config = replace(BASE, learning_rate=0.5, learning_rate_floor=0.2, final_rounds=2)
    run = recorded(tmp_path, config)
    rates = []
    for run.updates in (0, 9, 17):
        run.update()
        rates.append(run.optimisers["optimiser"].param_groups[0]["lr"])
    assert rates == pytest.approx([0.5, 0.3, 0.5 * (1 - 17 / 18 * 0.8)])


def test_late_decisions_are_drawn_more_often_where_asked(tmp_path: Path) -> None:
    for recency, middle in ((0.0, 1 / 2), (2.0, 3 / 4)):
        run = recorded(tmp_path, replace(BASE, batch_size=4000, recency=recency))
        drawn = run.drawn()
        assert drawn.min() >= 0 and drawn.max() < len(run.data)
        assert drawn.mean() / (len(run.data) - 1) == pytest.approx(middle, abs=0.02)


def test_the_positive_view_of_mvd_is_any(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, seen = recorded(tmp_path, method="mvd"), set()

    def own_loss(merge: Any, now: Any, then: Any, positive: int, precision: Any) -> Tensor:
        seen.add(positive)
        return sum((p.sum() for p in merge.parameters()), torch.zeros(()))

    monkeypatch.setattr(type(run.agent.encoder), "own_loss", own_loss)
    for _ in range(12):
        run.update()
    assert seen == {0, 1, 2}


# --- A state in units of its spread ----------------------------------------------------------


def test_the_state_is_read_as_it_is_unless_the_policy_says_otherwise() -> None:
    state = torch.randn(3, 6)
    assert read_state(NetworkConfig(6, 2), state) is state
    config = NetworkConfig(
        6, 2, state_changes=((4, 2), (5, 3)), state_mean=(1.0,) * 8, state_spread=(2.0,) * 8
    )
    assert config.state_inputs == 8
    speeds = state[:, 4:] - state[:, 2:4]
    expected = (torch.cat([state, speeds], 1) - 1) / 2
    assert torch.equal(read_state(config, state), expected)
    assert read_state(config, 100 + state).max() == 5, "cut off far from what was trained on"


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"state_mean": (0.0,), "state_spread": (1.0,)}, "state_mean of 6 numbers, found 1"),
        ({"state_mean": (0.0,) * 6, "state_spread": (0.0,) * 6}, "6 finite numbers above 0"),
        ({"state_mean": (float("inf"),) * 6, "state_spread": (1.0,) * 6}, "finite state_mean"),
        ({"state_changes": ((6, 0),)}, "state numbers below 6, found"),
    ],
)
def test_a_reading_that_cannot_be_carried_out_is_refused(wrong: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        NetworkConfig(6, 2, **wrong)


def test_mean_and_std_are_those_of_the_demonstrations_and_go_with_the_policy(
    tmp_path: Path,
) -> None:
    config = replace(BASE, standard_state=True)
    plan = toy_plan()
    networks = config.networks(ToyReach().spec, ())
    assert networks.state_changes == ((4, 2), (5, 3))
    assert config.networks(ToyReach().spec, (4, 5)).state_changes == (), "the paper's state alone"
    run = LightRun(replace(plan, networks=networks), config, tmp_path)
    run.add([record_episode(ToyReach(), THREE, Driver(1.0, 0.6), seed) for seed in (1, 2)], 0, [])
    states = run.data.column("states", np.arange(50)).numpy()
    read = np.concatenate([states, states[:, 4:] - states[:, 2:4]], 1)
    for agent in (run.agent, run.average):
        for told in (agent.config, agent.actor.config, agent.critic.config, agent.target.config):
            assert isinstance(told, NetworkConfig)
            np.testing.assert_allclose(told.state_mean, read.mean(0), atol=1e-6)
            np.testing.assert_allclose(told.state_spread, read.std(0), atol=1e-6)


def test_what_hardly_varies_is_not_magnified() -> None:
    mean, spread = mean_and_std(np.array([[1.0, 5.0], [3.0, 5.0]], np.float32))
    assert mean == (2.0, 5.0) and spread == (1.0, 1e-3)


# --- Losses that are off by default ----------------------------------------------------------


def test_places_are_learned_by_trunk_and_encoder_beside_the_action(tmp_path: Path) -> None:
    run = recorded(tmp_path, replace(BASE, position_weight=0.2))
    assert run.places is not None
    run.updates, index = HALF_WAY, decisions(run)
    agent, head = copy.deepcopy(run.agent).double(), copy.deepcopy(run.places).double()
    run.update()

    views = run.data.views(index)
    state, label, places = (
        run.data.column(name, index).double() for name in ("states", "labels", "places")
    )
    every = run.data.column("places", np.arange(50)).double()
    wanted = (places - every.mean(0)) / every.std(0, correction=0).clamp(min=1e-3)
    shares, total = (0.7, 0.1, 0.1, 0.1), torch.zeros((), dtype=torch.float64)
    for share, row in zip(shares, exact_rows(agent, views), strict=True):
        hidden = torch.cat([state, agent.actor.trunk(row)], 1)  # type: ignore[operator]
        action = torch.tanh(agent.actor(row, state)[0])
        total += share * (action - label).square().mean()
        total += share * 0.2 * (head.mlp(hidden) - wanted).square().mean()
    total.backward()
    for part, exact in ((run.agent, agent), (run.places, head)):
        found = dict(part.named_parameters())
        for name, before in exact.named_parameters():
            expected = before if before.grad is None else before - 0.5 * before.grad
            torch.testing.assert_close(
                found[name].double(), expected.detach(), rtol=1e-4, atol=1e-6, msg=name
            )
    assert not any("places" in name for name in run.average.acting_state())


def test_places_need_an_environment_that_knows_them_and_one_feature() -> None:
    class Silent:
        """An environment without places()."""

    actor = Actor(NetworkConfig(6, 2, hidden_dim=8))
    with pytest.raises(UserError, match="give it a method places()"):
        check_places(actor, cast(Environment, Silent()))
    with pytest.raises(UserError, match="found q-mean"):
        check_places(ActorHead(), ToyReach())
    check_places(actor, ToyReach())


def test_places_that_cannot_be_told_are_refused_before_anything_is_recorded(tmp_path: Path) -> None:
    config = TrainConfig("toy/reach", "q-mean", "light", out=tmp_path)
    with pytest.raises(UserError, match="found q-mean"):
        train(replace(config, light=LightConfig(position_weight=0.1)), lambda event: None)
    assert not list((tmp_path / "resume").glob("*.json")), "the corrected command can begin"


def test_a_choice_costs_its_divergence() -> None:
    mean = torch.tensor([[0.3, -2.0, 0.0, 5.0]])
    label = torch.tensor([0.5, 1.0, 0.0, -1.0])
    p, q = (1 + label) / 2, (1 + torch.tanh(mean[0])) / 2
    expected = [
        sum(a * np.log(a / b) for a, b in ((x, y), (1 - x, 1 - y)) if a > 0)
        for x, y in zip(p.double().numpy(), q.double().numpy(), strict=True)
    ]
    np.testing.assert_allclose(choice_errors(mean, label)[0], expected, rtol=1e-3, atol=1e-6)
    assert choice_errors(torch.atanh(label[:1]), label[:1]).item() == pytest.approx(0, abs=1e-6)


def test_a_gripper_by_choice_changes_the_last_number_alone(tmp_path: Path) -> None:
    run = recorded(tmp_path)
    views, state, label = torch.randn(4, 3, 3136), torch.randn(3, 6), torch.rand(3, 2)
    mean = run.agent.actor(views, state.expand(4, 3, 6))[0]
    arm = (torch.tanh(mean[..., 0]) - label[:, 0]).square()
    for kind, last in (
        ("square", (torch.tanh(mean[..., 1]) - label[:, 1]).square()),
        ("cross-entropy", choice_errors(mean[..., 1], label[:, 1])),
    ):
        found = light.row_errors(run.agent, views, state, label, kind)
        torch.testing.assert_close(found, ((arm + last) / 2).mean(1))


# --- Noise -----------------------------------------------------------------------------------


class Still(ToyReach):
    """An expert that always wants the same."""

    def expert(self) -> np.ndarray:
        return np.array([0.1, -0.1], np.float32)

    def reset(self, seed: int) -> TimeStep:
        self.spec = replace(self.spec, horizon=600)
        return super().reset(seed)

    def view(self, camera: str, size: int | None = None) -> Any:
        return super().view(camera, 2)


def test_an_expert_without_noise_does_what_it_says() -> None:
    episode = record_episode(ToyReach(), THREE, Driver(1.0, 0.0), 3)
    assert np.array_equal(episode.actions, episode.labels)
    assert np.array_equal(episode.places[0, :2], episode.places[-1, :2])


def test_a_share_of_the_actions_is_random() -> None:
    episode = record_episode(Still(), THREE, Driver(1.0, 0.3), 3)
    random = episode.actions[(episode.actions != episode.labels).any(1)]
    assert len(random) / 600 == pytest.approx(0.3, abs=0.06)
    np.testing.assert_allclose(np.quantile(random, [0.1, 0.5, 0.9]), [-0.8, 0, 0.8], atol=0.15)


def test_the_gentle_noise_is_small_and_changes_slowly() -> None:
    episode = record_episode(Still(), THREE, Driver(1.0, 0.0, noise_spread=0.2), 3)
    noise = episode.actions - episode.labels
    assert noise.std() == pytest.approx(0.2, abs=0.03) and abs(noise.mean()) < 0.08
    for each in noise.T:
        assert np.corrcoef(each[:-1], each[1:])[0, 1] == pytest.approx(0.8, abs=0.05)


def test_the_expert_drives_its_share_and_less_from_round_to_round(tmp_path: Path) -> None:
    run = recorded(tmp_path, replace(BASE, noise_spread=0.4, noise_decay=0.5))
    shares = [{driver.expert_share for driver, _ in run.drivers(k)} for k in range(4)]
    assert shares == [{1.0}, {0.5}, {0.4}, {0.5 * 0.8**2}]
    spreads = [{driver.noise_spread for driver, _ in run.drivers(k)} for k in range(4)]
    assert spreads == [{0.4}, {0.4}, {0.2}, {0.1}]
    student = run.drivers(1)[0][0].student
    driver = Driver(0.25, 0.0, student, np.ones(3, bool))
    episode = record_episode(ToyReach(), THREE, driver, 3)
    by_expert = (episode.actions == episode.labels).all(1).mean()
    assert 0.05 < by_expert < 0.5
