"""A policy that learned from recordings, at the robot: its own units, its own pictures."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.sync.server import ServerConnection

from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.measure.audit.recorded import RecordedAudit
from madviz.policies.checkpoint import load_policy, robot_of_policy
from madviz.recorded.films import letterboxed
from madviz.recorded.known import VARIABLE, allow_recording, recordings_of
from madviz.recorded.recordings import open_recordings
from madviz.recorded.robot import robot_of
from madviz.serving.dry_run import dry_run
from madviz.serving.episodes import BadLook, ServedEpisodes
from madviz.serving.serve import PolicyServer, ServeConfig, run_serve
from madviz.training.config import TrainConfig
from madviz.training.light_options import LightConfig
from madviz.training.train import train
from madviz.wire.reference import with_wire
from tests.recordings import TASKS, TOP, Small
from tests.wires import foreign_server, wiring_file

FEW = LightConfig(rounds=1, updates_per_round=1, batch_size=4, hidden_dim=16)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Recordings, and a policy that learned from them."""
    root = tmp_path_factory.mktemp("robot")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(root / "cache"))
        patch.setenv(VARIABLE, "")
        bench = Small(episodes=4, films=False).write(root / "bench")
        train(TrainConfig(recording=bench, out=root / "mad", light=FEW), lambda _: None)
    return bench, root / "mad"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that does not know the recordings."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(VARIABLE, "")


def test_the_robots_pictures_and_numbers_are_scaled_where_the_policy_is_served(
    trained: tuple[Path, Path],
) -> None:
    policy = load_policy(trained[1])
    robot = robot_of_policy(str(trained[1]))
    assert robot is not None
    rng = np.random.default_rng(1)
    images = {
        "top": rng.integers(0, 255, (48, 64, 3), np.uint8),
        "wrist": rng.integers(0, 255, (128, 96, 3), np.uint8),  # Twice the recorded size.
    }
    state = np.array([0.5, -1.0, 2.0], np.float32)
    with closing(ServedEpisodes(policy, 3, robot)) as episodes:
        action = episodes.act(images, state)
    small = [letterboxed(picture, 84).transpose(2, 0, 1) for picture in images.values()]
    views = np.stack([np.concatenate([one] * 3) for one in small])  # (V, 9, 84, 84)
    encoded = policy.encode(views, robot.states.scale(state))
    expected = policy.read(encoded, np.ones((1, 2), bool)).action[0]
    assert np.allclose(action, robot.actions.unscale(expected), atol=1e-6)
    low, high = np.array(robot.actions.low), np.array(robot.actions.high)
    assert ((action >= low) & (action <= high)).all()


def test_a_picture_of_another_aspect_is_refused(trained: tuple[Path, Path]) -> None:
    policy = load_policy(trained[1])
    episodes = ServedEpisodes(policy, 3, robot_of_policy(str(trained[1])))
    squashed = np.full((84, 84, 3), 9, np.uint8)
    for picture in (np.zeros((64, 64, 3), np.uint8), squashed):
        with pytest.raises(BadLook, match="'top' as 48 by 64 pixels, as it was recorded"):
            episodes.act({"top": picture}, np.zeros(3))
    boxed = letterboxed(squashed[:63], 84)
    assert not np.array_equal(boxed, squashed)
    episodes.act({"top": boxed}, np.zeros(3))
    jpeg = np.clip(boxed.astype(int) + np.arange(84)[:, None, None] % 5, 0, 255).astype(np.uint8)
    episodes.act({"top": jpeg}, np.zeros(3))


def test_a_served_policy_answers_as_the_folder_does(trained: tuple[Path, Path]) -> None:
    bench, folder = trained
    policy = load_policy(folder)
    server = PolicyServer(policy, robot=robot_of_policy(str(folder))).start()  # Without recordings.
    allow_recording(bench)
    try:
        served = load_policy(server.address)
        rng = np.random.default_rng(0)
        shots = [rng.integers(0, 255, (48, 64, 3), np.uint8), np.ones((64, 48, 3), np.uint8)]
        boxed = [letterboxed(shot, 84).transpose(2, 0, 1) for shot in shots]
        views = np.stack([np.concatenate([one] * 3) for one in boxed])  # (V, 9, 84, 84)
        state = np.array([0.1, -0.4, 0.9], np.float32)
        masks = np.array([[True, True], [False, True]])
        here, there = (each.read(each.encode(views, state), masks) for each in (policy, served))
        assert np.allclose(here.action, there.action, atol=1e-4)
        noisy = rng.integers(0, 255, (2, 9, 84, 84), np.uint8)  # Noise is on the bars as well.
        here, there = (each.read(each.encode(noisy, state), masks) for each in (policy, served))
        assert np.allclose(here.action, there.action, atol=1e-4)
    finally:
        server.close()


def test_a_policy_of_python_code_is_served_in_the_robots_units(
    trained: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, _ = trained
    allow_recording(bench)
    running: list[PolicyServer] = []
    monkeypatch.setattr(PolicyServer, "run", lambda server: running.append(server))
    run_serve(ServeConfig("tests.recorded_policy:make", port=0))
    (server,) = running
    robot = robot_of(open_recordings(bench))
    assert server._robot == replace(robot, trained_on=frozenset())


def test_another_programs_policy_gets_pictures_as_they_were_recorded(
    trained: tuple[Path, Path], tmp_path: Path
) -> None:
    looks: list[dict[str, Any]] = []

    def answer(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any]:
        looks.append(look)
        return {"actions": look["state"] + [0.25, 0, 0]}

    file = {
        "task": f'"{allow_recording(trained[0])}"',
        "size": "{ top = [24, 32], wrist = 32 }",
        "cameras": '{ top = "top", wrist = "wrist" }',
        "absolute": "{ state = [0, 1, 2], step = 1.0 }",
    }
    with foreign_server(answer, "openpi") as address:
        served = load_policy(with_wire(address, wiring_file(tmp_path, **file)))
        size = served.spec.image_size
        shots = [np.full(shape, 200, np.uint8) for shape in ((48, 64, 3), (64, 48, 3))]
        views = np.stack([letterboxed(shot, size).transpose(2, 0, 1) for shot in shots])
        robot = robot_of(recordings_of(served.spec.task))
        raw = (np.array(robot.states.low) + np.array(robot.states.high)) / 2
        encoded = served.encode(views, robot.states.scale(raw.astype(np.float32)))
        action = served.read(encoded, np.ones((1, 2), bool)).action[0]
    assert size == 32 and looks[0]["top"].shape == (24, 32, 3)
    assert (looks[0]["top"] == 200).all(), "no bars"
    assert (looks[0]["wrist"][:, 4:28] == 200).all() and not looks[0]["wrist"][:, :4].any()
    assert np.allclose(looks[0]["state"], raw, atol=1e-5)
    low, high = np.array(robot.actions.low), np.array(robot.actions.high)
    expected = 2 * (np.array([0.25, 0, 0]) - low) / (high - low) - 1
    assert np.allclose(action, expected, atol=1e-5), "a step from the raw state"
    wrong = with_wire(address, wiring_file(tmp_path, **{**file, "size": "[24, 32]"}))
    with pytest.raises(UserError, match="the size of 'wrist' to be a square"):
        load_policy(wrong)


def test_a_served_policy_gets_what_was_recorded(tmp_path: Path) -> None:
    """The episode's own words, and the raw state also where training has one value alone."""
    looks: list[dict[str, Any]] = []

    def answer(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any]:
        looks.append(look)
        return {"actions": np.zeros(3, np.float32)}

    small = Small(episodes=4, films=False)
    small.states[:, 1] = np.repeat([0.1, 5.0], [18, 6])  # The last episode is held out.
    small.rows["observation.state"] = list(small.states)
    task = allow_recording(small.write(tmp_path / "two"))
    file = {"task": f'"{task}"', "cameras": '{ top = "top", wrist = "wrist" }'}
    with foreign_server(answer, "openpi") as address, closing(make_env(task)) as env:
        served = load_policy(with_wire(address, wiring_file(tmp_path, **file)))
        recordings = recordings_of(task)
        audit = RecordedAudit(served, robot_of(recordings), recordings, env.spec, ("dropped",))
        for episode in range(4):
            state = env.reset(episode).state
            encoded = served.encode(np.zeros((2, 3, 84, 84), np.uint8), state)
            served.read(encoded, np.ones((1, 2), bool))
            audit.answers(episode, np.array([0]), {})
            for look in looks:
                assert look["prompt"] == TASKS[episode % 2]
                np.testing.assert_array_equal(look["state"], small.states[6 * episode])
            looks.clear()
        own = load_policy(with_wire(address, wiring_file(tmp_path, **file, instruction='"lift"')))
        own.read(own.encode(np.zeros((2, 3, 84, 84), np.uint8), state), np.ones((1, 2), bool))
        assert looks[0]["prompt"] == "lift"


def test_a_dry_run_says_rate_jump_and_what_was_out_of_range(trained: tuple[Path, Path]) -> None:
    bench, folder = trained
    robot = robot_of_policy(str(folder))
    lines = dry_run(load_policy(folder), robot, bench)
    assert "6 frames of episode 3 of bench (the policy was not trained on it)" in lines[0]
    assert "recorded: actions change nothing" in lines[0]
    states, _ = open_recordings(bench).numbers(3)
    assert robot is not None
    raw = open_recordings(bench).numbers(3)[1].astype(np.float64)
    largest = np.sqrt(((np.diff(raw, axis=0) / np.array(robot.spread)) ** 2).mean(1)).max()
    assert f"the largest recorded one is {largest:.2f}" in lines[2]
    named = [robot.state_names[i] for i in np.flatnonzero(np.any(robot.outside(states), axis=0))]
    assert all(name in lines[3] for name in named) and ("nothing" in lines[3]) == (not named)
    assert lines[-1].startswith("On this machine the policy keeps up with the robot's 10 a second")
    assert "no robot moved" in lines[-1]


def test_a_dry_run_says_what_it_knows_of_the_training(trained: tuple[Path, Path]) -> None:
    bench, folder = trained
    policy = load_policy(folder)
    robot = robot_of_policy(str(folder))
    assert robot is not None
    older = replace(robot, trained_on=frozenset())
    assert "whether the policy was trained on it is not known" in dry_run(policy, older, bench)[0]
    recordings = open_recordings(bench)
    known = [recordings.digest(one.index) for one in recordings.episodes]
    all_of_it = replace(robot, trained_on=frozenset(known))
    assert "was trained on it, as on all that are here" in dry_run(policy, all_of_it, bench)[0]


def test_a_dry_run_refuses_another_robot(trained: tuple[Path, Path], tmp_path: Path) -> None:
    other = Small(films=False, sizes={TOP: (48, 64)}).write(tmp_path / "other")
    policy = load_policy(trained[1])
    with pytest.raises(UserError, match="expected the policy's cameras top, wrist, found top"):
        dry_run(policy, robot_of_policy(str(trained[1])), other)
    four = Small(films=False, numbers=4).write(tmp_path / "four")
    with pytest.raises(UserError, match="expected the policy's states"):
        dry_run(policy, robot_of_policy(str(trained[1])), four)
    with pytest.raises(UserError, match="learned from recordings for --check"):
        dry_run(policy, None, trained[0])
