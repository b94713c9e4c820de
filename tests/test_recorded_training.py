"""Policies that learn from recordings: no simulator, held-out episodes, what the robot needs."""

from __future__ import annotations

import csv
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from madviz.envs.registry import make_env
from madviz.errors import Interrupted, UserError
from madviz.observation.ablation import Ablation
from madviz.observation.streams import StreamStack
from madviz.policies.checkpoint import load_policy
from madviz.recorded.known import VARIABLE, allow_recording
from madviz.recorded.recordings import Recordings, open_recordings
from madviz.recorded.robot import read_robot, robot_of, write_robot
from madviz.system.files import read_json, write_json
from madviz.training.config import TrainConfig, resolve
from madviz.training.light_options import LightConfig
from madviz.training.recorded import RecordedDataset
from madviz.training.train import train
from tests.recordings import Small

FEW = LightConfig(rounds=2, updates_per_round=2, batch_size=8, hidden_dim=16)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset of 4 episodes, of which the last one is held out."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(VARIABLE, "")
    return Small(episodes=4, films=False).write(tmp_path / "bench")


def run(bench: Path, out: Path, **options: Any) -> list[dict[str, Any]]:
    """Trains; the events."""
    events: list[dict[str, Any]] = []
    train(TrainConfig(recording=bench, out=out, light=FEW, threads=1, **options), events.append)
    return events


def test_a_policy_learns_from_recordings_and_says_that_success_was_not_measured(
    bench: Path, tmp_path: Path
) -> None:
    run(bench, tmp_path / "mad")
    rows = list(csv.DictReader((tmp_path / "mad/curve.csv").read_text().splitlines()))
    assert [float(row["error_top"]) > 0 for row in rows] == [True, True]
    assert not any("success" in column for column in rows[0])
    assert {"error_all", "error_wrist", "error_none"} <= set(rows[0])
    card = (tmp_path / "mad/card.md").read_text()
    assert "madviz explore --recording bench --policy mad\n" in card
    assert "imitation of recordings; success was not measured" in card
    for file in (tmp_path / "mad").iterdir():
        assert file.is_dir() or str(tmp_path).encode() not in file.read_bytes(), file
    policy = load_policy(tmp_path / "mad")
    assert policy.spec.task == "recording/bench"
    with_all = policy.encode(np.zeros((2, 9, 84, 84), np.uint8), np.zeros(3, np.float32))
    assert np.isnan(policy.read(with_all, np.ones((1, 2), bool)).q).all()


@pytest.mark.parametrize("method", ["merged-only", "singular-only", "single"])
def test_other_methods_learn_from_the_same_recordings(
    bench: Path, tmp_path: Path, method: str
) -> None:
    run(bench, tmp_path / method, method=method)
    spec = load_policy(tmp_path / method).spec
    assert spec.method == method
    cameras = [camera.name for camera in read_robot(tmp_path / method).cameras]
    assert cameras == list(spec.streams), "a client sends those that the policy sees"


def test_an_episode_that_is_left_out_does_not_count_as_trained_on(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = open_recordings(bench)
    assert 0 in known.training
    monkeypatch.setattr(Recordings, "fault", lambda _, one, *__: "it is torn" * (one == 0))
    events = run(bench, tmp_path / "mad")
    assert [event["why"] for event in events if event["kind"] == "left out"] == ["it is torn"]
    trained_on = read_robot(tmp_path / "mad").trained_on
    assert trained_on == {known.digest(one) for one in known.training if one}


def test_a_stopped_training_goes_on_to_the_same_weights(bench: Path, tmp_path: Path) -> None:
    run(bench, tmp_path / "whole")
    config = TrainConfig(recording=bench, out=tmp_path / "half", light=FEW, threads=1)

    def stop(event: dict[str, Any]) -> None:
        if event.get("round") == 1:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted) as stopped:
        train(config, stop)
    assert f"--recording {bench}" in str(stopped.value)
    train(replace(config, resume=True), lambda _: None)
    weights = [(tmp_path / name / "weights.safetensors").read_bytes() for name in ("whole", "half")]
    assert weights[0] == weights[1]


def test_a_training_does_not_go_on_with_other_recordings(bench: Path, tmp_path: Path) -> None:
    run(bench, tmp_path / "mad")
    (tmp_path / "mad/resume/finished").unlink()
    more = Small(episodes=5, films=False).write(tmp_path / "more" / "bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, "")
        with pytest.raises(UserError, match="another configuration: held_out"):
            run(more, tmp_path / "mad", resume=True)


def test_a_training_does_not_go_on_with_other_actions_of_the_same_episodes(
    bench: Path, tmp_path: Path
) -> None:
    run(bench, tmp_path / "mad")
    (tmp_path / "mad/resume/finished").unlink()
    other = Small(episodes=4, films=False)
    other.actions[:6] = other.actions[:6][::-1]
    other.rows["action"] = list(other.actions)
    other.write(tmp_path / "more" / "bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, "")
        with pytest.raises(UserError, match="another configuration: recorded_numbers"):
            run(tmp_path / "more" / "bench", tmp_path / "mad", resume=True)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"recipe": "paper"}, "expected the recipe light for recordings"),
        ({"task": "metaworld/push"}, "expected --recording without --task"),
        ({"method": "mv-mwm"}, "recipes"),
    ],
)
def test_what_needs_a_simulator_is_refused(
    bench: Path, tmp_path: Path, options: dict[str, Any], expected: str
) -> None:
    with pytest.raises(UserError, match=expected):
        run(bench, tmp_path / "mad", **options)


def test_options_that_record_are_refused(bench: Path, tmp_path: Path) -> None:
    config = TrainConfig(
        recording=bench, out=tmp_path / "mad", light=replace(FEW, noise_share=0.5, demonstrations=3)
    )
    with pytest.raises(UserError, match="noise_share, demonstrations"):
        train(config, lambda _: None)
    assert not (tmp_path / "mad").exists()


def test_a_batch_is_what_the_environment_shows(bench: Path) -> None:
    task = allow_recording(bench)
    plan = resolve(TrainConfig(task=task, light=FEW))
    found = open_recordings(bench)
    robot = robot_of(found)
    data = RecordedDataset(found, found.training, robot, plan)
    assert len(data) == 3 * 6
    env = make_env(task, "fast")
    index = 0
    for seed in range(3):
        stack = StreamStack(env.spec, plan.spec.streams)
        now = env.reset(seed)
        for step in range(6):
            views = {name: env.view(name) for name in plan.spec.streams}
            stack.push(views, Ablation(), seed, step)
            at = np.array([index])
            assert np.array_equal(data.views(at)[0].numpy(), stack.views)
            assert np.allclose(data.column("states", at)[0].numpy(), now.state)
            assert np.allclose(data.column("labels", at)[0].numpy(), env.expert(), atol=1e-6)
            following = data.following(at)[0]
            assert following == (index + 1 if step < 5 else index)
            now = env.step(env.expert())
            index += 1


def test_the_distance_is_in_units_of_the_spread(bench: Path) -> None:
    found = open_recordings(bench)
    robot = robot_of(found)
    rng = np.random.default_rng(0)
    first, second = rng.uniform(-1, 1, (2, 5, 3))
    raw = [robot.actions.unscale(one).astype(np.float64) for one in (first, second)]
    training = np.concatenate([found.numbers(index)[1] for index in found.training])
    spread = training.astype(np.float64).std(axis=0)
    expected = np.sqrt((((raw[0] - raw[1]) / spread) ** 2).mean(-1))
    assert np.allclose(robot.distance(first, second), expected, rtol=1e-5)


def test_a_robot_comes_back_from_its_file(bench: Path, tmp_path: Path) -> None:
    robot = robot_of(open_recordings(bench))
    write_robot(tmp_path, robot)
    assert read_robot(tmp_path) == robot
    content = read_json(tmp_path / "robot.json")
    del content["trained_on"]  # As in older files.
    write_json(tmp_path / "robot.json", content)
    assert read_robot(tmp_path) == replace(robot, trained_on=frozenset())
    document = read_json(tmp_path / "robot.json")
    for key, value in (("spread", [1.0, 0.0, 1.0]), ("low", [9.0, 9.0, 9.0]), ("high", [1.0])):
        write_json(
            tmp_path / "robot.json", {**document, "action": {**document["action"], key: value}}
        )
        with pytest.raises(UserError, match=r"robot\.json: expected"):
            read_robot(tmp_path)
