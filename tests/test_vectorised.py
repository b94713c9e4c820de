"""The recipe paper-vectorised: many environments in step, and that stopping it changes nothing."""

from __future__ import annotations

import csv
import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from madviz.agent.agent import TorchPolicy
from madviz.agent.networks import NetworkConfig
from madviz.envs.toy import CAMERAS, ToyReach
from madviz.errors import UserError
from madviz.measure.episodes import Stopped, run_episode
from madviz.observation.ablation import Ablation
from madviz.policies.checkpoint import load_policy
from madviz.runs import reward_run
from madviz.runs.drawn_task import DrawnTask
from madviz.runs.vector_envs import Board, VectorEnvs
from madviz.training.config import TrainConfig, resolve
from madviz.training.paper import ShiftingPolicy
from madviz.training.vectorised import VectorisedConfig
from madviz.types import Array, TimeStep
from tests.fakes import FakePolicy, random_policy
from tests.recipe_runs import assert_same_run, curve, last_state, stops_at

STREAMS = ("first.rgb", "first.depth", "third_b.rgb")
TASK = DrawnTask("toy/reach", "fast", CAMERAS, STREAMS)
TINY = VectorisedConfig(
    steps=80, exploration_steps=40, batch_size=4, hidden_dim=8, eval_every=1000, eval_episodes=1,
    save_every=30, precision="float32", environments=2, workers=0, update_ratio=0.2,
)  # fmt: skip
"""Two lanes: episodes of 25 decisions are 50 in all; the run ends in the middle of the second."""


def run(
    folder: Path, config: VectorisedConfig = TINY, resume: bool = False, listener: Any = None
) -> dict[str, Any]:
    whole = TrainConfig(
        "toy/reach", "mad", "paper-vectorised", out=folder, seed=3, resume=resume, threads=1,
        vectorised=config,
    )  # fmt: skip
    return last_state(whole, listener)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("vectorised") / "run"
    return folder, run(folder)


def board(lanes: int) -> Board:
    return Board(lanes, STREAMS, state_dim=6, action_dim=2)


def test_lanes_in_processes_are_the_environments_themselves() -> None:
    envs = VectorEnvs(TASK, board(3), lanes=3, workers=2)
    alone = [ToyReach() for _ in range(3)]
    rng = np.random.default_rng(0)
    try:
        for seeds in ([4, 5, 6], [7, 4, 9]):
            envs.reset(seeds)
            for env, seed in zip(alone, seeds, strict=True):
                env.reset(seed)
            for step in range(25):
                actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
                envs.send(actions)
                envs.receive()
                for lane, env in enumerate(alone):
                    now = env.step(actions[lane])
                    np.testing.assert_array_equal(envs.board["state"][lane], now.state)
                    assert envs.board["reward"][lane] == now.reward
                    assert envs.board["last"][lane] == (step == 24)
                    first, depth, third = envs.frames(lane)
                    np.testing.assert_array_equal(first, env.view("first").rgb)
                    np.testing.assert_array_equal(third, env.view("third_b").rgb)
                    assert depth.shape == (84, 84, 1) and depth.any()
    finally:
        envs.close()


def test_an_error_in_a_worker_is_raised_here_and_a_death_is_noticed() -> None:
    envs = VectorEnvs(TASK, board(2), lanes=2, workers=1)
    envs.reset([1, 2])
    envs.send(np.full((2, 2), np.nan, np.float32))
    with pytest.raises(UserError, match="finite action"):
        envs.receive()
    envs.close()
    envs = VectorEnvs(TASK, board(1), lanes=1, workers=1)
    (worker,) = multiprocessing.active_children()
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    with pytest.raises(UserError, match="exit code -9.*--resume") as died:
        envs.reset([1])
    assert "try fewer workers" in str(died.value), "an option of no recipe: two have such lanes"
    envs.close()


def test_what_cannot_be_built_says_so_at_once() -> None:
    with pytest.raises(UserError, match="unknown task"):
        VectorEnvs(replace(TASK, task="toy/teach"), board(1), lanes=1, workers=1)


def test_the_schedule(undisturbed: tuple[Path, dict[str, Any]]) -> None:
    folder, state = undisturbed
    assert state["step"] == 80 and state["episodes"] == 4
    # The last updates are made at decision 78, for the 38 since exploration: a fifth of them.
    assert state["updates"] == 7
    rows = curve(folder)
    assert [row["step"] for row in rows] == ["0", "80"]
    with (folder / "curve.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["env_steps_per_s"]) > 0 and float(last["updates_per_s"]) > 0
    assert (folder / "curve.svg").read_text().startswith("<svg")


def test_the_folder_is_a_policy_that_names_its_recipe(
    undisturbed: tuple[Path, dict[str, Any]],
) -> None:
    policy = load_policy(undisturbed[0])
    assert policy.spec.name == "toy-reach-mad-paper-vectorised"
    assert policy.spec.recipe == "paper-vectorised"
    config = TrainConfig("toy/reach", recipe="paper-vectorised", vectorised=TINY)
    words = resolve(config).command
    assert "--recipe paper-vectorised" in words and "--vectorised.update-ratio 0.2" in words


def test_processes_change_nothing(undisturbed: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    state = run(tmp_path / "run", replace(TINY, workers=2))
    assert_same_run(state, undisturbed[1])
    assert curve(tmp_path / "run") == curve(undisturbed[0])


def test_a_stopped_run_goes_on_in_mid_episode_and_ends_the_same(
    undisturbed: tuple[Path, dict[str, Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reward_run, "PROGRESS_SECONDS", 0)
    state = run(tmp_path / "run", listener=stops_at(66))
    assert state["step"] == 66 and not state["between_episodes"]
    state = run(tmp_path / "run", replace(TINY, workers=1), resume=True)
    assert_same_run(state, undisturbed[1])
    assert curve(tmp_path / "run") == curve(undisturbed[0])


def test_updates_are_made_while_the_lanes_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log: list[str] = []

    def logged(owner: type, name: str) -> None:
        original = getattr(owner, name)

        def call(self: Any, *arguments: Any) -> Any:
            log.append(name)
            return original(self, *arguments)

        monkeypatch.setattr(owner, name, call)

    logged(VectorEnvs, "send")
    logged(VectorEnvs, "receive")
    monkeypatch.setattr(
        "madviz.agent.update.Learner.step", lambda learner, batch: log.append("update")
    )
    run(tmp_path / "run", replace(TINY, update_ratio=1.0, steps=48, eval_episodes=0))
    assert log[:40] == ["send", "receive"] * 20, "exploration"
    assert log[40:] == ["send", "receive", *["send", "update", "update", "receive"] * 3]


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("shifts", [False, True])
def test_lanes_play_together_what_evaluations_play_one_at_a_time(
    workers: int, shifts: bool
) -> None:
    spec = replace(FakePolicy().spec, streams=STREAMS)
    agent = random_policy(spec, NetworkConfig(state_dim=6, action_dim=2, hidden_dim=8)).agent
    policy = ShiftingPolicy(spec, agent, True) if shifts else TorchPolicy(spec, agent)
    subsets = np.array([[1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1]], bool)
    jobs = list(zip(subsets, range(1000, 1005), strict=True))
    expected = [run_episode(policy, ToyReach(), mask, Ablation(), seed) for mask, seed in jobs]
    envs = VectorEnvs(TASK, board(3), lanes=3, workers=workers)
    try:
        asked = iter([False] * 30)
        with pytest.raises(Stopped):  # While the last two are played.
            envs.play(policy, jobs, lambda: next(asked, True))
        for one, alone in zip(envs.play(policy, jobs, lambda: False), expected, strict=True):
            assert one.total_reward == pytest.approx(alone.total_reward, rel=1e-5)
            assert replace(one, total_reward=alone.total_reward) == alone
        envs.reset([1, 2, 3])  # No answer was left in a pipe, and every camera is drawn again.
        assert all(frame.any() for lane in range(3) for frame in envs.frames(lane))
    finally:
        envs.close()


class Early(ToyReach):
    """Ends at its seed's last two digits, in success; then its hand is driven off."""

    def reset(self, seed: int) -> TimeStep:
        self._ends = seed % 100
        return super().reset(seed)

    def step(self, action: Array) -> TimeStep:
        now = super().step(action)
        return replace(now, success=self._step == self._ends, last=self._step >= self._ends)


def test_a_lane_that_ends_before_others_counts_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DrawnTask, "build", lambda self: Early())
    spec = replace(FakePolicy().spec, streams=STREAMS)
    policy = random_policy(spec, NetworkConfig(state_dim=6, action_dim=2, hidden_dim=8))
    jobs = [(np.ones(3, bool), 1005), (np.ones(3, bool), 1009)]
    envs = VectorEnvs(TASK, board(2), lanes=2, workers=0)
    together = envs.play(policy, jobs, lambda: False)
    envs.close()
    for one, (mask, seed) in zip(together, jobs, strict=True):
        alone = run_episode(policy, Early(), mask, Ablation(), seed)
        assert one.success and one.total_reward == pytest.approx(alone.total_reward, rel=1e-5)


def test_a_training_whose_lanes_end_apart_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(DrawnTask, "build", lambda self: Early())
    with pytest.raises(UserError, match="equally long, found one that ended before the others"):
        run(tmp_path / "run", replace(TINY, eval_episodes=0))


def test_lanes_draw_only_what_an_episode_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []
    view = ToyReach.view
    monkeypatch.setattr(
        ToyReach, "view", lambda self, camera: drawn.append(camera) or view(self, camera)
    )
    spec = replace(FakePolicy().spec, streams=STREAMS)
    policy = random_policy(spec, NetworkConfig(state_dim=6, action_dim=2, hidden_dim=8))
    envs = VectorEnvs(TASK, board(3), lanes=3, workers=0)
    assert envs.play(policy, [(np.array([0, 0, 1], bool), 1000)], lambda: False)
    envs.close()
    assert drawn == ["third_b"] * 26, "and lanes without an episode draw nothing"


def test_cuda_is_refused_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert VectorisedConfig().frames_device() == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert VectorisedConfig().frames_device() == "cuda"
    assert VectorisedConfig(buffer_on_host=True).frames_device() == "cpu"
    assert VectorisedConfig(buffer_on_disk=True).frames_device() == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert VectorisedConfig().torch_device() == "cpu"
    with pytest.raises(UserError, match="expected a CUDA device"):
        VectorisedConfig(device="cuda").torch_device()


def test_numbers_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    for option, number in (("environments", 0), ("workers", -1), ("update_ratio", -1)):
        name = option.replace("_", "-")
        with pytest.raises(UserError, match=f"--vectorised.{name}: expected .* found {number}"):
            run(tmp_path / name, replace(TINY, **{option: number}))
    assert not list(tmp_path.iterdir()), "a run that never began is in nobody's way"


@pytest.mark.slow
def test_mad_learns_toy_reach_with_many_environments(tmp_path: Path) -> None:
    config = VectorisedConfig(
        steps=4_000, exploration_steps=500, batch_size=48, buffer_capacity=4_000, hidden_dim=128,
        discount=0.9, learning_rate=1e-3, eval_every=4_000, eval_episodes=20, environments=8,
        workers=2,
    )  # fmt: skip
    run(tmp_path / "run", config)
    row = {k: float(v) for k, v in curve(tmp_path / "run")[-1].items()}
    singles = [row[f"success_{name}"] for name in ("first", "third_a", "third_b")]
    assert row["success_all"] >= 0.7, row
    assert np.mean(singles) >= 0.5, row
