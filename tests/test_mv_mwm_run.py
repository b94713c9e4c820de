"""The recipe mv-mwm: its tables and command, its batches, and that stopping it changes nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from madviz import cli
from madviz.agent.agent import Agent
from madviz.agent.methods import METHODS
from madviz.envs.toy import CAMERAS, ToyReach
from madviz.errors import UserError
from madviz.policies.card import card_text
from madviz.policies.checkpoint import load_policy
from madviz.runs import reward_run
from madviz.runs.buffer import BufferSpec, ReplayBuffer, Stretch
from madviz.runs.demonstrations import Dataset, Driver, record_episode
from madviz.runs.drawn_task import newest_frames
from madviz.subsets import every_mask
from madviz.sweep.sweep import SweepConfig, run_sweep
from madviz.training.config import RECIPES, TrainConfig, resolve
from madviz.types import Array
from madviz.world_model.learner import WorldLearner
from madviz.world_model.mv_mwm_options import MvMwmConfig
from madviz.world_model.recipe import beside, demonstrated
from madviz.world_model.sizes import MvMwmOptions
from tests.recipe_runs import assert_same_run, curve, facts_of, last_state, stops_at
from tests.test_merges import perturb

STREAMS = tuple(camera.name for camera in CAMERAS)
TINY = MvMwmConfig(
    steps=80, exploration_steps=40, batch_size=8, size="tiny", pretraining=4, world_pretraining=2,
    pictures=3, ahead=2, horizon=3, imagined_starts=5, target_every=2, eval_every=50,
    eval_episodes=1, save_every=30, environments=2, workers=0, update_ratio=0.1,
)  # fmt: skip
"""Two lanes: episodes of 25 decisions are 50 in all; the run ends in the middle of the second."""


SHORT = replace(TINY, steps=12, exploration_steps=1, eval_every=1000)
"""Explores for less than a lane needs to have two decisions in a row."""


def asked(folder: Path | None = None, config: MvMwmConfig = TINY, **changes: Any) -> TrainConfig:
    whole = TrainConfig("toy/reach", "mv-mwm", "mv-mwm", out=folder, seed=3, threads=1)
    return replace(whole, mv_mwm=config, **changes)


def run(
    folder: Path, config: MvMwmConfig = TINY, resume: bool = False, listener: Any = None
) -> dict[str, Any]:
    return last_state(asked(folder, config, resume=resume), listener)


def test_a_stretch_is_drawn_only_when_there_is_one(tmp_path: Path) -> None:
    state = run(tmp_path, SHORT)
    assert state["drawn"] >= SHORT.pretraining and state["updates"] >= SHORT.world_pretraining


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("mv-mwm") / "run"
    return folder, run(folder)


# --- Tables and command -------------------------------------------------------------------------


def test_method_and_recipe_are_in_their_tables() -> None:
    assert RECIPES["mv-mwm"].options == "mv_mwm"
    assert [name for name, row in METHODS.items() if "mv-mwm" in row.recipes] == ["mv-mwm"]
    assert METHODS["mv-mwm"].recipes == ("mv-mwm",)
    with pytest.raises(UserError, match="'mv-mae' has the recipes light, not 'mv-mwm'"):
        resolve(asked(method="mv-mae"))


def test_the_command_says_what_was_asked_for_and_is_read_again() -> None:
    whole = asked(config=replace(TINY, size="paper", demonstrations=10))
    words = resolve(whole).command.split()
    assert words[:8] == "madviz train --task toy/reach --method mv-mwm --recipe mv-mwm".split()
    text = " ".join(words)
    assert "--mv-mwm.size paper --mv-mwm.demonstrations 10" in text
    assert cli.parse("train", words[2:]) == replace(whole, out=None)


def test_one_option_stands_for_the_papers_sizes() -> None:
    small, paper = (resolve(asked(config=MvMwmConfig(size=s))).networks for s in ("small", "paper"))
    own = paper.own_as(MvMwmOptions)
    assert own.autoencoder.width == 256 and own.autoencoder.layers == 8
    assert own.autoencoder.decoder_layers == 6 and own.autoencoder.heads == 4
    world = own.world_model
    assert (world.memory, world.groups, world.classes, world.head_layers) == (1024, 32, 32, 4)
    assert (world.reader_width, world.reader_layers, paper.hidden_dim) == (128, 2, 512)
    assert small.own_as(MvMwmOptions).world_model.memory < 1024 and small.hidden_dim == 256
    assert resolve(asked(config=MvMwmConfig(hidden_dim=99))).networks.hidden_dim == 99
    standard = MvMwmConfig()
    numbers = standard.horizon, standard.mixture, standard.entropy_weight, standard.target_every
    assert numbers == (15, 0.95, 1e-4, 100) and standard.demonstrations == 0
    assert standard.numbers_of("metaworld/hammer").discount == 0.99


def test_a_sweep_of_it_is_planned_without_training(tmp_path: Path) -> None:
    file = tmp_path / "one.toml"
    file.write_text(
        '[grid]\ntasks = ["toy/reach"]\nmethods = ["mv-mwm"]\nrecipes = ["mv-mwm"]\n'
        "[grid.train]\nmv-mwm.steps = 50\n"
    )
    found = run_sweep(SweepConfig(str(file), out=tmp_path / "out", dry_run=True))
    assert found["waiting"] == 1 and not (tmp_path / "out").exists()


def test_the_number_of_processes_may_change() -> None:
    one, two = asked(), asked(config=replace(TINY, workers=7))
    assert facts_of(one) == facts_of(two)
    assert facts_of(one) != facts_of(asked(config=replace(TINY, ahead=3)))


# --- Batches ------------------------------------------------------------------------------------


def test_a_stretch_is_what_was_seen_and_done() -> None:
    spec = BufferSpec(STREAMS, state_dim=6, action_dim=2, capacity=100, horizon=5, lanes=2)
    buffer, envs, rng = ReplayBuffer(spec), [ToyReach(), ToyReach()], np.random.default_rng(0)
    frames: list[list[Array]] = []
    numbers: list[tuple[Array, Array, float]] = []
    for episode in range(3):
        states = [env.reset(10 * episode + lane).state for lane, env in enumerate(envs)]
        for lane, env in enumerate(envs):
            frames.append(newest_frames(env, STREAMS))
            buffer.begin(states[lane], frames[-1])
        for step in range(5):
            for lane, env in enumerate(envs):
                action = rng.uniform(-1, 1, 2).astype(np.float32)
                now = env.step(action)
                numbers.append((states[lane], action, now.reward))
                states[lane] = now.state
                frames.append(newest_frames(env, STREAMS))
                buffer.add(action, now.reward, 0.9 * (step < 4), now.state, frames[-1])
    index = buffer.draw(40, rng, ahead=3)
    ages = index // 2 % 6
    assert set(ages) == {0, 1, 2}, "three decisions of one episode follow"
    seen = buffer.stretch(index, 3)
    assert seen.frames.shape == (6, 40, 3, 3, 84, 84)
    for b, (i, age) in enumerate(zip(index.tolist(), ages, strict=True)):
        for t in range(6):
            shown = i + 2 * max(t - 2, -age)
            for v in range(3):
                expected = frames[shown][v].transpose(2, 0, 1)
                np.testing.assert_array_equal(seen.frames[t, b, v].numpy(), expected)
        first = i // 12 * 10 + i % 12  # Every sixth time step has no decision.
        for step in range(3):
            state, action, reward = numbers[first + 2 * step]
            np.testing.assert_array_equal(seen.state[step, b].numpy(), state)
            np.testing.assert_array_equal(seen.action[step, b].numpy(), action)
            assert seen.reward[step, b].item() == np.float32(reward)
            assert seen.follows[step, b].item() == (age + step < 4)
    with pytest.raises(ValueError, match="6 transitions in a row"):
        buffer.draw(1, rng, ahead=6)


def test_an_experts_stretches_stand_beside_those_of_the_run() -> None:
    data, episode = Dataset(STREAMS, 1, 25), record_episode(ToyReach(), STREAMS, Driver(), 4)
    counted = np.arange(25, dtype=np.float32)[:, None].repeat(6, 1)  # Tells the decisions apart.
    episode = replace(episode, states=counted)
    data.add(episode)
    stretch, labels = demonstrated(data, 30, 4, np.random.default_rng(0))
    starts = set()
    for b in range(30):
        start = int(stretch.state[0, b, 0])
        assert stretch.state[:, b, 0].tolist() == [start + step for step in range(5)]
        starts.add(start)
        for t in range(3 + 4):
            shown = max(start + t - 2, 0)
            for v, name in enumerate(STREAMS):
                expected = episode.frames[name][shown]
                np.testing.assert_array_equal(stretch.frames[t, b, v].numpy(), expected)
        np.testing.assert_array_equal(labels[:, b].numpy(), episode.labels[start : start + 5])
        np.testing.assert_array_equal(
            stretch.action[:, b].numpy(), episode.actions[start : start + 4]
        )
        np.testing.assert_array_equal(
            stretch.reward[:, b].numpy(), episode.rewards[start : start + 4]
        )
    assert min(starts) <= 2 and max(starts) >= 18 and max(starts) <= 20
    both = beside(stretch, replace(stretch, reward=stretch.reward + 1))
    assert both.frames.shape[1] == 60 and both.reward.shape == (4, 60)
    assert torch.equal(both.reward[:, 30:], stretch.reward + 1), "labels are the last samples'"


# --- What an update reaches ---------------------------------------------------------------------


def learner_and_stretch(config: MvMwmConfig = TINY) -> tuple[WorldLearner, Stretch, Tensor]:
    plan = resolve(asked(config=config))
    data = Dataset(STREAMS, 1, 25)
    data.add(record_episode(ToyReach(), STREAMS, Driver(), 4))
    stretch, labels = demonstrated(data, 6, config.ahead, np.random.default_rng(0))
    return WorldLearner(plan.new_agent(), config, 0.9), stretch, labels


def moved_by(agent: Agent, what: Any) -> set[str]:
    before = {name: p.detach().clone() for name, p in agent.named_parameters()}
    what()
    moved = {n for n, p in agent.named_parameters() if not torch.equal(p, before[n])}
    return {".".join(name.split(".")[: 2 if name.startswith("encoder") else 1]) for name in moved}


def test_each_loss_moves_what_is_its_own() -> None:
    learner, stretch, labels = learner_and_stretch()
    agent = learner.agent
    pictures = stretch.frames[-1], stretch.reward[0]
    assert moved_by(agent, lambda: learner.learn_pictures(*pictures)) == {"encoder.autoencoder"}
    moved = moved_by(agent, lambda: learner.update(stretch))
    assert moved == {"encoder.world", "actor", "critic"}
    assert "target" in moved_by(agent, lambda: learner.update(stretch, labels)), "every second"
    for mine, slow in zip(agent.critic.parameters(), agent.target.parameters(), strict=True):
        assert torch.equal(mine, slow) and not slow.requires_grad
    assert all(p.requires_grad for p in learner.net.parameters())


def test_rates_fall_in_a_line_to_their_floor() -> None:
    learner, _, _ = learner_and_stretch(replace(TINY, world_rate=0.4, rate_floor=0.25))
    for progress, expected in ((0.0, 0.4), (0.5, 0.25), (1.0, 0.1)):
        learner.set_learning_rates(progress)
        assert learner.optimisers["world"].param_groups[0]["lr"] == pytest.approx(expected)
    pictures = learner.optimisers["pictures"].param_groups[0]
    assert pictures["lr"] == pytest.approx(0.25 * TINY.autoencoder_rate)


def test_an_imagination_begins_where_the_acting_policy_stands() -> None:
    learner, stretch, _ = learner_and_stretch()
    rng = np.random.default_rng(0)
    random = rng.integers(0, 256, tuple(stretch.frames.shape), np.uint8)
    stretch = replace(stretch, frames=torch.from_numpy(random))
    perturb(learner.net, 0.5)  # So that pictures change a belief.
    with pytest.MonkeyPatch.context() as patch:
        present = torch.ones(6, 3, dtype=torch.bool)
        patch.setattr("madviz.world_model.learner.drawn_views", lambda *_: present)
        off = torch.autocast("cpu", enabled=False)
        patch.setattr("madviz.world_model.learner.autocast", lambda: off)
        patch.setattr(learner, "_uniform", lambda *shape: None)  # The likeliest, as it acts.
        belief, state = learner._starts(learner._window(stretch))
    for step in range(TINY.ahead + 1):
        views = stretch.frames[step : step + 3].permute(1, 2, 0, 3, 4, 5).flatten(2, 3)
        rows = learner.net.rows(learner.net.encode(views), torch.ones(1, 3))
        mine = belief.feature.unflatten(0, (TINY.ahead + 1, 6))[step]
        torch.testing.assert_close(mine, rows[0], rtol=1e-4, atol=1e-4)
        assert torch.equal(state.unflatten(0, (-1, 6))[step], stretch.state[step])


def test_cloning_is_the_squared_error_of_the_last_samples_which_have_labels() -> None:
    learner, stretch, labels = learner_and_stretch()
    belief, state = learner._starts(learner._window(stretch))
    found = learner._cloning_loss(belief, state, labels[:, 2:]).item()
    middle = torch.tanh(learner.actor(belief.feature, state)[0]).detach().unflatten(0, (3, 6))
    errors = (middle.numpy() - labels.numpy())[:, 2:] ** 2
    assert found == pytest.approx(errors.mean(), rel=1e-5)


def test_the_world_model_learns_its_stretches() -> None:
    learner, stretch, _ = learner_and_stretch(replace(TINY, world_rate=3e-3))
    losses = [learner.update(stretch) for _ in range(80)]
    first, last = losses[0], losses[-1]
    assert last["features_loss"] < 0.7 * first["features_loss"]
    assert last["reward_loss"] < 0.5 * first["reward_loss"]
    assert last["reward_explained"] > first["reward_explained"]


# --- A run --------------------------------------------------------------------------------------


def test_the_schedule(undisturbed: tuple[Path, dict[str, Any]]) -> None:
    folder, state = undisturbed
    assert state["step"] == 80 and state["episodes"] == 4
    # The last updates are made at decision 78, for the 38 since exploration: a tenth of them.
    assert state["updates"] == 2 + 3 and state["drawn"] == 4 + 3
    assert state["learner"]["updates"] == 3, "while exploring the world model learned alone"
    rows = curve(folder)
    assert [row["step"] for row in rows] == ["0", "50", "80"]
    for name in (*WorldLearner.loss_names, "success_all", "success_first", "success_third_b"):
        assert np.isfinite(float(rows[-1][name])), name
    for name, rate in (("pictures", TINY.autoencoder_rate), ("actor", TINY.heads_rate)):
        found = state["learner"]["optimisers"][name]["param_groups"][0]["lr"]
        assert found == pytest.approx(rate * (1 - 0.9 * 78 / 80)), "at the last decision"
    assert (folder / "curve.svg").read_text().startswith("<svg")


def test_the_folder_is_a_policy_whose_card_says_what_differs(
    undisturbed: tuple[Path, dict[str, Any]],
) -> None:
    policy = load_policy(undisturbed[0])
    assert policy.spec.name == "toy-reach-mv-mwm-mv-mwm"
    rng = np.random.default_rng(0)
    views = rng.integers(0, 256, (3, 9, 84, 84), np.uint8)
    found = policy.read(policy.encode(views, np.zeros(6, np.float32)), every_mask(3)[:-1])
    assert np.isfinite(found.action).all() and np.isfinite(found.q).all()
    card = card_text(undisturbed[0])
    for words in (
        "in the imagination of a world model", "rebuilt from nothing over a frame stack",
        "the state is given to actor and critic", "views are dropped uniformly",
    ):  # fmt: skip
        assert words in card


@pytest.mark.parametrize(
    ("kind", "step", "updates"), [("progress", 66, 4), ("curve", 50, 2)], ids=["mid", "evaluated"]
)
def test_a_stopped_run_goes_on_and_ends_the_same(
    kind: str,
    step: int,
    updates: int,
    undisturbed: tuple[Path, dict[str, Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In mid-episode, and between an evaluation and the next decision."""
    monkeypatch.setattr(reward_run, "PROGRESS_SECONDS", 0)
    state = run(tmp_path / "run", listener=stops_at(step, kind))
    assert state["step"] == step and state["updates"] == updates
    assert state["between_episodes"] == (kind == "curve")
    state = run(tmp_path / "run", replace(TINY, workers=1), resume=True)
    assert_same_run(state, undisturbed[1])
    assert curve(tmp_path / "run") == curve(undisturbed[0])


def test_the_smallest_buffer_has_enough_decisions_in_a_row_at_any_time(tmp_path: Path) -> None:
    config = replace(TINY, buffer_capacity=14, update_ratio=1.0)
    assert run(tmp_path / "run", config)["step"] == config.steps


def test_stretches_that_are_never_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--mv-mwm.ahead below the 25 decisions"):
        run(tmp_path / "a", replace(TINY, ahead=25))
    with pytest.raises(UserError, match="--mv-mwm.buffer-capacity of 14 or more.*found 13"):
        run(tmp_path / "a", replace(TINY, buffer_capacity=13))
    assert not list(tmp_path.iterdir()), "a run that never began is in nobody's way"


def test_the_mean_picture_is_of_what_was_seen(undisturbed: tuple[Path, dict[str, Any]]) -> None:
    mean: Tensor = undisturbed[1]["learner"]["agent"]["encoder.autoencoder.mean"]
    assert mean.shape == (3, 3, 84, 84) and 0.1 < mean.mean() < 0.6
    assert (mean[2].std((1, 2)) > 0.01).all()


def test_an_update_at_the_papers_sizes() -> None:
    learner, stretch, _ = learner_and_stretch(
        replace(TINY, size="paper", imagined_starts=2, horizon=2)
    )
    losses = learner.learn_pictures(stretch.frames[-1], stretch.reward[0])
    losses |= learner.update(stretch)
    assert all(np.isfinite(loss) for loss in losses.values()) and "actor_loss" in losses
