"""A recording on a page: distances in place of success, and the label that says why."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from madviz.app.panels.breaks import BreakPanel
from madviz.app.panels.policy import policy_words, status_html
from madviz.app.panels.recorded import (
    RecordedPanel,
    distances,
    recorded_html,
    training_words,
)
from madviz.app.panels.shapley import shapley_html
from madviz.app.panels.subsets import action_bars, subsets_html
from madviz.app.panels.timeline import timeline_html
from madviz.app.panels.words import Prediction, asks_now, sentence
from madviz.app.server import ExploreConfig, with_recording
from madviz.app.success_rates import SuccessRates
from madviz.errors import UserError
from madviz.measure.evaluate import EvalConfig, run_eval
from madviz.observation.ablation import CameraState
from madviz.policies.checkpoint import load_policy
from madviz.recorded.known import LABEL, VARIABLE, allow_recording
from madviz.recorded.recordings import open_recordings
from madviz.recorded.robot import robot_of
from madviz.recorded.scaling import apart
from madviz.recording.record import RecordConfig, run_record
from madviz.session.commands import Compare, MoveCamera, SetCamera
from madviz.session.frame import Frame
from madviz.session.open_loop import from_recorded, without_camera
from madviz.training.config import TrainConfig
from madviz.training.light_options import LightConfig
from madviz.training.train import train
from tests.recorded_policy import Bright
from tests.recordings import TASKS, Small
from tests.sessions import OFF, Recorder

FORBIDDEN = re.compile(r"succe|goal met|\bfail", re.IGNORECASE)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset that is known as recording/mine."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(VARIABLE, "")
    written = Small().write(tmp_path / "mine")
    allow_recording(written)
    return written


def played(steps: int = 3, policy=None, **options) -> tuple[Recorder, Frame]:
    session = Recorder(policy or Bright(), seed=1, **options)
    session.at(0.0)
    return session, session.steps(steps)


def test_distances_are_in_units_of_the_spread(folder: Path) -> None:
    assert apart(np.array([1.0, 0.0]), np.array([0.0, 2.0]), (1.0, 2.0)) == pytest.approx(1.0)
    still = apart(np.array([1.0, 5.0]), np.array([0.0, 2.0]), (1.0, 0.0))
    assert still == pytest.approx(1.0), "a number that never changes counts for nothing"
    session, frame = played()
    recorded = frame.world.recorded
    assert recorded is not None and (recorded.episode, recorded.task) == (1, TASKS[1])
    spread = np.array(frame.world.env.action_spread)
    off = (frame.action - recorded.action) / spread
    assert from_recorded(frame) == pytest.approx(float(np.sqrt((off**2).mean())))
    with_all = frame.action
    dropped = session.ask(SetCamera("top", OFF))
    expected = apart(with_all, dropped.action, frame.world.env.action_spread)
    assert expected > 0
    assert without_camera(frame, "top") == pytest.approx(expected)
    assert without_camera(dropped, "top") == pytest.approx(expected)
    assert set(distances(frame)) == {"", "top", "wrist"}


def test_it_ends_where_the_recording_does_and_says_nothing_of_success(folder: Path) -> None:
    session, frame = played(5)
    session.ask(SetCamera("top", OFF))
    frame = session.frames[-1]
    assert frame.ended and frame.world.step == frame.decisions == 5
    rates = SuccessRates()
    change = frame.world.change
    assert change is not None
    html = (
        status_html(frame)
        + recorded_html(frame, lambda name: 0.5)
        + timeline_html(frame)
        + shapley_html(frame, rates)
        + sentence(change, frame, rates)
    )
    assert not FORBIDDEN.search(html), FORBIDDEN.search(html)
    assert LABEL in html and TASKS[1] in html and "with and without Top" in html
    assert ">END<" in html and "Top dropped: action changed by" in html


def test_every_number_has_its_name_and_no_q_is_shown(folder: Path) -> None:
    _, frame = played()
    recorded = frame.world.recorded
    assert recorded is not None
    html = recorded_html(frame, lambda name: 0.5, "A sentence.")
    assert "A sentence." in html
    off = abs(frame.action - recorded.action) / np.array(frame.world.env.action_spread)
    names = open_recordings(folder).action_names
    for name, *numbers in zip(names, frame.action, recorded.action, off, strict=True):
        row = next(row for row in html.split("<tr>") if f"<td>{name}</td>" in row)
        assert re.findall(r">([^<]+)</td>", row)[1:] == [f"{number:.2f}" for number in numbers]
    assert ">Q<" not in subsets_html(frame) + timeline_html(frame)
    assert policy_words(replace(frame.world.policy, method="mad")) == "MAD, trained on recordings."
    wide = action_bars(np.array([0.5, -0.25]), figures=False)
    assert wide.count('title="+0.50"') == 1 and ">+0.50<" not in wide


def test_means_begin_again_where_a_camera_is_changed(folder: Path, server) -> None:
    session, frame = played()
    panel = RecordedPanel(server.gui, frame)

    def now_and_mean(frame: Frame) -> tuple[str, ...]:
        (content,) = panel.update(frame)
        row = re.search(r"from the recording</td>(.*?)</tr>", content.value)
        assert row is not None
        return tuple(re.findall(r">([^<]+)</td>", row[1]))

    now, mean = now_and_mean(session.steps(1))
    assert now != mean
    now, mean = now_and_mean(session.ask(SetCamera("top", OFF)))
    assert now == mean
    back = session.ask(SetCamera("top", CameraState("rgb")))
    now, mean = now_and_mean(back)
    assert now != mean, "steps with all cameras are remembered"
    other = replace(back.world.policy, name="another")
    now, mean = now_and_mean(replace(back, world=replace(back.world, policy=other)))
    assert now == mean, "another policy"


def test_what_the_policy_was_trained_on_is_said(folder: Path) -> None:
    recordings = open_recordings(folder)
    robot = robot_of(recordings)
    assert training_words(robot, recordings, 2) == "The policy was not trained on this episode."
    assert "number 2 is new to it" in training_words(robot, recordings, 0)
    for unknown in (None, replace(robot, trained_on=frozenset())):
        assert "not known" in training_words(unknown, recordings, 0)
    all_of_it = frozenset(map(recordings.digest, range(3)))
    words = training_words(replace(robot, trained_on=all_of_it), recordings, 0)
    assert "it was trained on all" in words


def test_it_begins_with_an_episode_that_the_policy_was_not_trained_on(folder: Path) -> None:
    out = folder.parent / "mad"
    light = LightConfig(rounds=1, updates_per_round=1, batch_size=4, hidden_dim=16)
    train(TrainConfig(recording=folder, out=out, light=light), lambda _: None)
    config = with_recording(ExploreConfig(policy=str(out), recording=folder))
    assert config.seed == 2
    assert with_recording(ExploreConfig(policy=str(out), recording=folder, seed=0)).seed == 0


def test_nobody_is_asked_to_guess(folder: Path) -> None:
    session, _ = played()
    assert not asks_now(session.ask(SetCamera("top", OFF)), Prediction())


def test_the_time_line_draws_how_far_from_the_recording(folder: Path) -> None:
    _, frame = played()
    assert len(frame.history) == 4
    assert frame.history[-1].reward == pytest.approx(from_recorded(frame))


def test_without_a_policy_the_recorded_action_is_shown(folder: Path) -> None:
    _, frame = played(policy=load_policy("recorded:mine"))
    assert np.isnan(from_recorded(frame)) and frame.world.policy.method == "none"
    recorded = frame.world.recorded
    assert recorded is not None
    html = status_html(frame)
    assert "Recorded action" in html and f"{recorded.action[0]:+.2f}" in html
    assert "There is no policy here" in recorded_html(frame, lambda name: 0.0)
    with pytest.raises(UserError, match="unknown recording 'recording/other'"):
        load_policy("recorded:other")


def test_comparing_and_moving_are_refused_in_one_line(folder: Path) -> None:
    from madviz.observation.displacement import Displacement

    session, frame = played()
    for command, words in (
        (Compare("other"), "expected a task in a simulator to compare two policies in"),
        (MoveCamera("top", Displacement(pan=10.0)), "expected cameras of recording/mine where"),
    ):
        said = session.ask(command).pace.error.splitlines()[0]
        assert said.startswith(words)


def test_a_recorded_camera_offers_no_depth_and_no_other_place(folder: Path, server) -> None:
    _, frame = played()
    panel = BreakPanel(server.gui, lambda command: None, frame)
    said = {change.name: change.value for change in panel.turn("top")}
    assert said["label"] == "Break Top"
    assert panel._sends.handle.visible and not panel._gives.handle.visible


def test_what_counts_successes_is_refused_for_recordings(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a task in a simulator for counting successes"):
        run_eval(EvalConfig("tests.recorded_policy:make", episodes=1, workers=0))
    with pytest.raises(UserError, match="expected a task in a simulator for madviz record"):
        run_record(RecordConfig(tmp_path / "x.html", "tests.recorded_policy:make"))


def test_the_option_names_a_task_and_begins_with_its_first_episode(folder: Path, capsys) -> None:
    config = with_recording(ExploreConfig(recording=folder))
    assert (config.task, config.policy, config.seed) == ("recording/mine", "recorded:mine", 0)
    own = "tests.recorded_policy:make"
    assert with_recording(ExploreConfig(policy=own, recording=folder)).policy == own
    with pytest.raises(UserError, match="--recording without --replay or --task"):
        with_recording(ExploreConfig(task="toy/reach", recording=folder))
    assert capsys.readouterr().err == ""


def test_episodes_that_are_left_out_are_said(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setenv(VARIABLE, "")
    broken = Small()
    broken.places[1]["length"] = 5
    with_recording(ExploreConfig(recording=broken.write(tmp_path / "broken")))
    assert "left out: episode 1: expected 5 steps in the table" in capsys.readouterr().err
