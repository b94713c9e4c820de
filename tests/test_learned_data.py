"""Trainings learn from what happened: what each path keeps, against a simple way to write it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

from madviz.envs.metaworld.environment import MetaWorld
from madviz.envs.toy import CAMERAS, ToyReach
from madviz.measure.store import EpisodeResult
from madviz.observation.ablation import Ablation
from madviz.observation.streams import StreamStack
from madviz.policies.checkpoint import load_policy
from madviz.policies.seeds import FIRST_SELECTION, use_of
from madviz.runs import lanes_run
from madviz.runs.demonstrations import Dataset, Driver, record_episode
from madviz.runs.drawn_task import DrawnTask, newest_frames
from madviz.runs.vector_envs import Board, VectorEnvs
from madviz.subsets import mask_of
from madviz.training.config import TrainConfig
from madviz.training.light import LightConfig
from madviz.training.paper import PaperConfig
from madviz.training.vectorised import VectorisedConfig
from madviz.types import Array
from tests.fakes import FakePolicy
from tests.plans import record_inline
from tests.recipe_runs import last_state

STREAMS = ("first.rgb", "first.depth", "third_b.rgb")
LANES = 3
HORIZON = 25


class KeptTransitions:
    """A fake buffer, which keeps its arguments in order."""

    def __init__(self) -> None:
        self.begun: list[tuple[Array, list[Array]]] = []
        self.added: list[tuple[Any, ...]] = []

    def begin(self, state: Array, frames: Any) -> None:
        self.begun.append((state.copy(), [np.array(frame) for frame in frames]))

    def add(self, action: Array, reward: float, discount: float, state: Array, frames: Any) -> None:
        kept = [np.array(frame) for frame in frames]
        self.added.append((action.copy(), reward, discount, state.copy(), kept))


def test_every_lane_keeps_its_own_transitions_and_only_the_last_has_no_discount() -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (HORIZON, LANES, 2)).astype(np.float32)
    acted = iter(actions)
    run: Any = SimpleNamespace(
        between_episodes=True,
        exploring=False,
        episodes=0,
        step=0,
        buffer=KeptTransitions(),
        draw_seeds=lambda lanes: list(range(40, 40 + lanes)),
        discount_of=lambda last: 0.0 if last else 0.8,
    )
    board = Board(LANES, STREAMS, state_dim=6, action_dim=2)
    envs = VectorEnvs(DrawnTask("toy/reach", "fast", CAMERAS, STREAMS), board, LANES, workers=0)
    learned = []
    for _ in range(HORIZON):
        lanes_run.advance(run, envs, lambda: next(acted), lambda: learned.append(run.step))
    envs.close()

    alone = [ToyReach() for _ in range(LANES)]
    kept = iter(run.buffer.added)
    for lane, env in enumerate(alone):
        now = env.reset(40 + lane)
        state, frames = run.buffer.begun[lane]
        np.testing.assert_array_equal(state, now.state)
        assert all(map(np.array_equal, frames, newest_frames(env, STREAMS)))
    for decision in range(HORIZON):
        for lane, env in enumerate(alone):
            now = env.step(actions[decision, lane])
            action, reward, discount, state, frames = next(kept)
            np.testing.assert_array_equal(action, actions[decision, lane])
            assert reward == np.float32(now.reward)
            assert discount == (0.0 if decision == HORIZON - 1 else 0.8)
            np.testing.assert_array_equal(state, now.state)
            assert all(map(np.array_equal, frames, newest_frames(env, STREAMS)))
    assert run.between_episodes and run.step == HORIZON * LANES
    assert learned == list(range(0, HORIZON * LANES, LANES)), "before its own decision is counted"


def test_light_learns_from_the_stacks_that_it_acts_on() -> None:
    """The newest frame is the last one, of a camera that sees the hand move."""
    seed = 3
    data = Dataset(STREAMS, 2, HORIZON)
    for each in (seed, seed + 1):
        data.add(record_episode(ToyReach(), STREAMS, Driver(noise_share=0.5), each))
    for episode, place in enumerate((seed, seed + 1)):
        env = ToyReach()
        stack = StreamStack(env.spec, STREAMS)
        now = env.reset(place)
        for decision in range(HORIZON):
            index = episode * HORIZON + decision
            stack.push({c: env.view(c) for c in ("first", "third_b")}, Ablation(), place, decision)
            np.testing.assert_array_equal(data.views(np.array([index]))[0], stack.views)
            assert torch.equal(data.column("states", np.array([index]))[0], torch.tensor(now.state))
            label = data.column("labels", np.array([index]))[0].numpy()
            np.testing.assert_array_equal(label, env.expert())
            now = env.step(data.column("actions", np.array([index]))[0].numpy())
            reward = data.column("rewards", np.array([index]))[0]
            assert reward == pytest.approx(now.reward)
    views = data.views(np.array([HORIZON + 10])).numpy()[0, 2]  # (9, H, W) of Third B.
    assert not np.array_equal(views[:3], views[6:])


class Subset(FakePolicy):
    """Remembers the masks that it was asked to act on."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[Array] = []

    def read(self, encoded: Any, masks: Array) -> Any:
        self.asked.append(masks)
        return super().read(encoded, masks)


def test_a_student_drives_with_its_own_action_on_its_own_streams() -> None:
    student = Subset()
    streams = student.spec.streams
    mask = mask_of("third_b", streams)
    driver = Driver(expert_share=0.0, noise_share=0.0, student=student, mask=mask)
    episode = record_episode(ToyReach(), streams, driver, 3)
    assert len(student.asked) == HORIZON
    assert all(np.array_equal(masks, mask[None]) for masks in student.asked)
    env = ToyReach()
    now = env.reset(3)
    assert not np.array_equal(episode.actions, episode.labels)
    for action, reward, state in zip(episode.actions, episode.rewards, episode.states, strict=True):
        np.testing.assert_array_equal(state, now.state)
        now = env.step(action)
        assert reward == np.float32(now.reward)


@pytest.mark.parametrize("task", ["hammer", "push"])
def test_meta_world_is_its_own_simulation_every_second_step(task: str) -> None:
    """Two steps of stock Meta-World are one decision: rewards add up, success is the second one's,
    and the state is hand and object (8 numbers) after the last three decisions."""
    seed = 5
    build: Any = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"]
    stock = build(seed=0)
    stock._freeze_rand_vec = False
    stock.seeded_rand_vec = True
    stock.seed(seed)
    stock.reset()
    observed = [stock.step(np.zeros(4, np.float32))[0]] * 3
    ours = MetaWorld(task)
    now = ours.reset(seed)
    rng = np.random.default_rng(1)
    for _ in range(12):
        expected = np.concatenate([np.concatenate([o[:4], o[18:22]]) for o in observed])
        np.testing.assert_allclose(now.state, expected, atol=1e-6)
        action = rng.uniform(-1.5, 1.5, 4)
        clipped = np.clip(action, -1, 1)
        rewards = []
        for _ in range(2):
            observation, reward, _, _, info = stock.step(clipped.astype(np.float32))
            rewards.append(reward)
        observed = [*observed[1:], observation]
        now = ours.step(action.astype(np.float32))
        assert now.reward == pytest.approx(sum(rewards), rel=1e-6)
        assert now.success == bool(info["success"])
        assert not np.isclose(rewards[0], sum(rewards)), "the test could not tell"
    assert not np.array_equal(now.state[:4], now.state[4:8]), "the test could not tell"
    ours.close()


SMALL_LIGHT = LightConfig(
    rounds=2, demonstrations=1, episodes_per_round=1, updates_per_round=3, batch_size=4,
    critic_updates=2, hidden_dim=8,
)  # fmt: skip


def test_light_ships_the_averaged_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record_inline(monkeypatch)
    out = tmp_path / "run"
    config = TrainConfig("toy/reach", "mad", "light", out=out, threads=1, light=SMALL_LIGHT)
    state = last_state(config)
    shipped: Any = load_policy(out)
    for name, weight in shipped.agent.state_dict().items():
        if name.split(".")[0] in ("encoder", "actor"):
            assert torch.equal(weight, state["average"][name].half().float()), name
            assert not torch.equal(weight, state["agent"][name].half().float()), name


SHORT = {
    "steps": 60,
    "exploration_steps": 30,
    "batch_size": 4,
    "hidden_dim": 8,
    "eval_every": 100_000,
    "eval_episodes": 3,
    "precision": "float32",
}


@pytest.mark.parametrize("recipe", ["paper", "paper-vectorised"])
def test_evaluations_in_training_use_selection_scenes(
    recipe: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same twenty every time, on all streams and on each alone; here three."""
    played: list[tuple[tuple[bool, ...], int]] = []

    def run_episode(policy: Any, env: Any, mask: Array, _: Any, seed: int, *more: Any) -> Any:
        played.append((tuple(map(bool, mask)), seed))
        return EpisodeResult("all", seed, True, True, 1.0)

    monkeypatch.setattr("madviz.training.paper.run_episode", run_episode)

    def play(lanes: Any, policy: Any, jobs: list[tuple[Array, int]], stop: Any) -> list[Any]:
        return [run_episode(policy, lanes, mask, None, seed) for mask, seed in jobs]

    monkeypatch.setattr("madviz.runs.vector_envs.VectorEnvs.play", play)
    vectorised = VectorisedConfig(**SHORT, environments=2, workers=0)
    config = TrainConfig(
        "toy/reach", "mad", recipe, out=tmp_path / "run", threads=1,
        paper=PaperConfig(**SHORT), vectorised=vectorised,
    )  # fmt: skip
    last_state(config)
    seeds = {seed for _, seed in played}
    assert seeds == set(range(FIRST_SELECTION, FIRST_SELECTION + 3))
    assert use_of(seeds) == "selection"
    masks = {(True, True, True), (True, False, False), (False, True, False), (False, False, True)}
    assert {mask for mask, _ in played} == masks
    assert len(played) == 2 * 4 * 3, "at the start and at the end"
