"""Many copies in one simulation. A CPU simulates one, and that one must be ``ManiSkill`` itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from madviz.envs.maniskill import batch
from madviz.envs.maniskill.batch import ManiSkillBatch
from madviz.envs.maniskill.environment import HORIZON, ManiSkill, cameras_of
from madviz.envs.maniskill.tasks import states
from madviz.envs.registry import MANISKILL_TASKS, make_env, setting_cameras
from madviz.errors import UserError
from madviz.training import vector_batch, vectorised
from madviz.training.config import TrainConfig
from madviz.training.drawn_task import DrawnTask
from madviz.training.run_folder import RunFolder
from madviz.training.train import train
from madviz.training.vector_batch import BatchedEnvs
from madviz.training.vector_envs import Board, VectorEnvs
from madviz.training.vectorised import VectorisedConfig
from madviz.types import EnvSpec, TimeStep, View

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:mani_skill")


def assert_same(batch: batch.Steps, alone: TimeStep) -> None:
    np.testing.assert_array_equal(batch.state, alone.state[np.newaxis])
    assert batch.reward == [np.float32(alone.reward)] and batch.last == alone.last
    assert batch.success.tolist() == [alone.success]


def assert_same_picture(batch: View, alone: View) -> None:
    """Rounding of a pose may move an edge by a little of a pixel, not more."""
    apart = np.abs(batch.rgb.astype(int) - alone.rgb.astype(int))
    assert apart.max() <= 8 and apart.mean() < 0.01
    np.testing.assert_allclose(batch.depth, alone.depth, atol=0.0011)
    assert (batch.rgb.dtype, batch.depth.dtype) == (np.uint8, np.float32)


@pytest.mark.parametrize("task", MANISKILL_TASKS)
def test_a_single_copy_is_the_environment_itself(task: str) -> None:
    alone, batch = ManiSkill(task), ManiSkillBatch(task, 1, device="cpu")
    rng = np.random.default_rng(0)
    for seed in (3, 4):
        assert_same(batch.reset([seed]), alone.reset(seed))
        for action in rng.uniform(-1.5, 1.5, (5, 4)).astype(np.float32):
            assert_same(batch.step(action[np.newaxis]), alone.step(action))
        views = batch.draw()
        assert list(views) == [camera.name for camera in alone.spec.cameras]
        for name, (view,) in views.items():
            assert_same_picture(view, alone.view(name))
    alone.close()
    batch.close()


@pytest.fixture(scope="module")
def five() -> Iterator[ManiSkillBatch]:
    cameras = setting_cameras("maniskill/pick-cube", "five")
    batch = ManiSkillBatch("pick-cube", 1, "full", cameras, device="cpu")
    yield batch
    batch.close()


def test_cameras_and_meshes_are_those_that_were_asked_for(five: ManiSkillBatch) -> None:
    alone = make_env("maniskill/pick-cube", "full", five.cameras)
    five.reset([8])
    alone.reset(8)
    views = five.draw()
    assert {"third_c", "top"} < views.keys() and len(views) == 5
    for name, (view,) in views.items():
        assert_same_picture(view, alone.view(name))
    alone.close()


def test_a_reset_that_builds_nothing_anew_begins_alike(five: ManiSkillBatch) -> None:
    """Which is how a GPU's are; the goal, which policies must not see, stays hidden."""
    fresh = five.reset([5])
    wanted = five.draw()
    for _ in range(4):
        five.step(np.full((1, 4), 0.9, np.float32))
    again = five.reset([5], rebuild=False)
    np.testing.assert_allclose(again.state, fresh.state, atol=1e-5)
    for name, (view,) in five.draw().items():
        assert_same_picture(view, wanted[name][0])


def test_an_episode_ends_when_it_is_over_and_nothing_is_drawn_unasked(
    five: ManiSkillBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(*_: Any) -> None:
        raise AssertionError("drawn")

    monkeypatch.setattr(five.simulation, "_get_obs_sensor_data", draw)
    assert not five.reset([1]).last
    still = np.zeros((1, 4), np.float32)
    assert [five.step(still).last for _ in range(HORIZON)] == [False] * (HORIZON - 1) + [True]


def test_bad_input_is_refused(five: ManiSkillBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="finite"):
        five.step(np.full((1, 4), np.nan, np.float32))
    with pytest.raises(UserError, match="one copy of a task on a CPU, found 2"):
        ManiSkillBatch("push-cube", 2, device="cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="expected a CUDA device to simulate ManiSkill on"):
        ManiSkillBatch("push-cube", 2)


# --- Training on it ---


@pytest.fixture
def on_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a GPU would do, with one copy on a CPU."""
    monkeypatch.setattr(vector_batch, "ManiSkillBatch", partial(ManiSkillBatch, device="cpu"))
    monkeypatch.setattr(vectorised, "claim_gpu", lambda: None)


def test_its_lanes_are_those_of_processes(on_cpu: None) -> None:
    streams = ("first.rgb", "third_a.depth", "third_b.rgb")
    env = make_env("maniskill/pull-cube")
    simulation = DrawnTask("maniskill/pull-cube", "fast", env.spec.cameras, streams)
    one, other = (Board(1, streams, env.spec.state_dim, 4) for _ in range(2))
    batched = BatchedEnvs(simulation, env.spec, one, 1)
    others = VectorEnvs(simulation, other, 1, workers=0)
    actions = np.random.default_rng(1).uniform(-1, 1, (4, 1, 4)).astype(np.float32)

    def assert_same_board() -> None:
        for name in ("state", "reward", "last"):
            np.testing.assert_array_equal(one[name], other[name])
        for mine, theirs in zip(batched.frames(0), others.frames(0), strict=True):
            assert mine.any() and mine.shape == theirs.shape
            assert np.abs(mine.astype(int) - theirs).max() <= 8

    for envs in (batched, others):
        envs.reset([6])
    assert_same_board()
    for action in actions[:2]:
        for envs in (batched, others):
            envs.send(action)
            envs.receive()
        assert_same_board()
    for envs in (batched, others):
        envs.repeat([7], actions[:3])
        envs.send(actions[3])
        envs.receive()
    assert_same_board()
    batched.close()
    others.close()
    env.close()


@pytest.mark.parametrize(("task", "size"), [("push-cube", 28), ("pick-cube", 29)])
def test_states_of_many_copies_are_rows(task: str, size: int) -> None:
    copies = 3

    def rows(width: int, start: float) -> torch.Tensor:
        return start + torch.arange(float(copies))[:, None].expand(copies, width)

    pose = SimpleNamespace(raw_pose=rows(7, 20), p=rows(3, 30))
    joints = SimpleNamespace(get_qpos=lambda: rows(9, 0), get_qvel=lambda: rows(9, 10))
    place = SimpleNamespace(pose=pose)
    simulation = SimpleNamespace(
        agent=SimpleNamespace(robot=joints, tcp=place), goal_region=place, goal_site=place
    )
    found = states(task, simulation, {"is_grasped": torch.tensor([True, False, True])})
    assert found.shape == (copies, size) and found.dtype == np.float32
    for column, start in ((0, 0), (9, 10), (-4, 20), (-1, 30)):
        assert found[:, column].tolist() == [start, start + 1, start + 2]
    if task == "pick-cube":
        np.testing.assert_array_equal(found[:, 18], [1, 0, 1])


def test_many_copies_fill_their_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    class Three:
        """Copies that say their number, and the actions they got."""

        def __init__(self, *arguments: Any) -> None:
            assert arguments[:3] == ("push-cube", 3, "fast")

        def reset(self, seeds: list[int]) -> batch.Steps:
            return self.step(np.array(seeds, np.float32)[:, np.newaxis].repeat(4, 1))

        def step(self, actions: np.ndarray) -> batch.Steps:
            self.actions = actions.copy()
            success = np.zeros(3, bool)
            return batch.Steps(actions.repeat(7, 1), actions[:, 0], success, last=True)

        def draw(self) -> dict[str, list[View]]:
            shape = (84, 84)
            views = [
                View(np.full((*shape, 3), 10 * i, np.uint8), np.full(shape, 1.0, np.float32))
                for i in range(3)
            ]
            return {"third_a": views}

    monkeypatch.setattr(vector_batch, "ManiSkillBatch", Three)
    spec = EnvSpec("maniskill/push-cube", cameras_of("push-cube"), 28, 4, 50)
    board = Board(3, ("third_a",), 28, 4)
    simulation = DrawnTask("maniskill/push-cube", "fast", spec.cameras, ("third_a",))
    envs = BatchedEnvs(simulation, spec, board, 3)
    envs.reset([7, 8, 9])
    assert board["reward"][:, 0].tolist() == [7, 8, 9] and board["last"].all()
    envs.send(np.arange(12, dtype=np.float32).reshape(3, 4))
    envs.receive()
    assert board["state"][:, 0].tolist() == [0, 4, 8]
    assert [envs.frames(lane)[0].max() for lane in range(3)] == [0, 10, 20]


def test_training_on_it_ends_with_the_same_weights(
    on_cpu: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the scenes of this seed, third B's pictures are the same to the last bit (of others they
    differ by the rounding of a pose), so the weights are."""
    monkeypatch.setattr(RunFolder, "finish", lambda self: None)
    tiny = VectorisedConfig(
        steps=60, exploration_steps=40, batch_size=4, hidden_dim=8, eval_every=1000,
        eval_episodes=1, precision="float32", environments=1, workers=0, update_ratio=0.2,
    )  # fmt: skip
    states = []
    for simulation in ("processes", "gpu"):
        out = tmp_path / simulation
        train(
            TrainConfig(
                "maniskill/push-cube", "single", "paper-vectorised", camera="third_b", out=out,
                seed=4, threads=1, vectorised=replace(tiny, simulation=simulation),
            ),
            lambda event: None,
        )  # fmt: skip
        states.append(torch.load(out / "resume" / "state.pt", weights_only=True))
    mine, theirs = (each["learner"]["agent"] for each in states)
    assert states[0]["updates"] == states[1]["updates"] > 0
    assert all(torch.equal(weight, theirs[name]) for name, weight in mine.items())


def test_the_gpu_is_claimed_before_anything_simulates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later, PhysX would refuse it."""

    class Claimed(Exception):
        pass

    def claim() -> None:
        raise Claimed

    def simulate(*_: Any) -> None:
        raise AssertionError("too early")

    monkeypatch.setattr(vectorised, "claim_gpu", claim)
    monkeypatch.setattr("madviz.training.drawn_task.make_env", simulate)
    settings = VectorisedConfig(simulation="gpu")
    config = TrainConfig("maniskill/push-cube", "mad", "paper-vectorised", out=tmp_path / "run")
    with pytest.raises(Claimed):
        train(replace(config, vectorised=settings))


def test_what_no_gpu_simulates_is_refused_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for task, wanted in (
        ("toy/reach", "a task of ManiSkill to simulate on a GPU, found toy/reach"),
        ("maniskill/push-cube", "expected a CUDA device to simulate ManiSkill on"),
    ):
        config = TrainConfig(
            task, "mad", "paper-vectorised", out=tmp_path / "run",
            vectorised=VectorisedConfig(simulation="gpu"),
        )  # fmt: skip
        with pytest.raises(UserError, match=wanted):
            train(config)
        assert not (tmp_path / "run").exists(), "the corrected command may take the same folder"
