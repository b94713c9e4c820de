"""The hand's path after a change of a camera, beside its path with all cameras."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from madviz.envs.toy import ToyReach
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.session.commands import (
    Command,
    Compare,
    Fork,
    Link,
    Pause,
    Play,
    Reset,
    Scrub,
    SetAutoNext,
    SetCamera,
    SetPolicy,
    SetSpeed,
)
from madviz.session.ending import ending_of
from madviz.session.frame import APART, HandPaths
from madviz.session.pace import HOLD_TO_READ
from madviz.session.retrace import Retrace
from madviz.session.session import Session
from madviz.session.transfer import FrameDecoder, FrameEncoder
from madviz.types import Encoded, Readout, TimeStep
from tests.fakes import FakePolicy, policies
from tests.sessions import BLACK, OFF, Recorder
from tests.test_ending import measured

LAST = 25
"""Decisions of the toy's episode."""


def hands(session: Recorder) -> np.ndarray:
    """(T, 3): the hand at every step of the newest episode, as the page was shown it."""
    now = session.frames[-1].world.episode
    shown = {f.world.step: f.world.hand for f in session.frames if f.world.episode == now}
    return np.array([shown[step] for step in range(LAST + 1)])


@cache
def intact(policy: str = "") -> np.ndarray:
    """(T, 3): the same seed's episode in which nothing was touched."""
    session = Recorder(policies(policy) if policy else None)
    session.steps(LAST)
    return hands(session)


def test_the_paths_are_those_of_the_episode_and_of_one_with_all_cameras() -> None:
    session = Recorder()
    session.steps(4)
    session.ask(SetCamera("first", OFF))
    paths = session.steps(LAST - 4).paths
    assert paths is not None and paths.since == 4
    np.testing.assert_array_equal(paths.taken, hands(session)[4:])
    np.testing.assert_array_equal(paths.intact, intact()[4:])
    assert not np.array_equal(paths.taken, paths.intact)


@pytest.mark.parametrize("change", [SetCamera("first", OFF), SetCamera("third_a", BLACK)])
def test_a_change_from_the_start_has_its_paths(change: SetCamera) -> None:
    session = Recorder()
    session.tick(0.0)
    session.ask(change)
    paths = session.steps(LAST).paths
    assert paths is not None and paths.since == 0
    np.testing.assert_array_equal(paths.intact, intact())
    session.ask(Reset())
    assert session.frames[-1].paths is None, "a new episode has none yet"


def test_both_sides_have_their_own_paths() -> None:
    session = Recorder()
    session.ask(Compare("toy-other"))
    session.steps(3)
    session.ask(SetCamera("first", OFF))
    frame = session.steps(LAST - 3)
    assert frame.paths is not None and frame.second is not None
    assert frame.second.paths is not None
    np.testing.assert_array_equal(frame.second.paths.intact, intact("toy-other")[3:])
    words = ending_of(frame, measured)
    assert words is not None and words.came_of_it.count(" cm") >= 2
    assert "MAD's hand was up to " in words.came_of_it and "; Merged Only's" in words.came_of_it
    session.ask(Link(False), Reset())
    for camera in ("first", "third_a"):
        session.ask(SetCamera(camera, OFF))
    frame = session.steps(LAST)
    assert frame.second is not None and frame.second.paths is not None


def test_the_environment_stands_where_the_episode_ended() -> None:
    session = Recorder()
    move = MoveCamera("third_a", Displacement(pan=20))
    session.ask(move)
    ended = session.steps(LAST)
    assert ended.paths is not None
    env = session._stage._live.env
    np.testing.assert_array_equal(env.hand(), ended.world.hand)
    np.testing.assert_array_equal(env.view("third_a").rgb, ended.world.views["third_a"].rgb)
    np.testing.assert_array_equal(env.pose("third_a").wxyz, ended.world.poses["third_a"].wxyz)


def in_mid_replay(*commands: Command) -> Recorder:
    """A session whose episode ended a moment ago, after ``commands`` at its first step."""
    session = Recorder()
    session.tick(0.0)
    session.ask(*commands)
    session.steps(LAST - 1)
    session.time = session._pace.due
    for _ in range(3):
        assert once(session) == session.time, "there is more to do"
    assert session.frames[-1].ended and session._stage.retracing
    return session


def once(session: Recorder, *commands: Command) -> float | None:
    """One tick, in which a replay takes one decision."""
    for command in commands:
        session.send(command)
    return Session.tick(session, session.time)


def test_the_end_stays_from_its_last_word_on() -> None:
    session = in_mid_replay(SetCamera("first", OFF))
    session.time += HOLD_TO_READ - 1.0  # The replay took that long.
    session.tick(session.time)
    assert session.frames[-1].paths is not None
    session.at(session.time + HOLD_TO_READ - 0.1)
    assert session.frames[-1].ended
    session.at(session.time + 0.2)
    assert not session.frames[-1].ended


def test_a_command_in_mid_replay_is_carried_out_and_the_replay_goes_on() -> None:
    session = in_mid_replay(SetCamera("first", OFF))
    once(session, SetCamera("third_a", BLACK))
    assert session.frames[-1].world.ablation.camera("third_a") == BLACK
    once(session, Pause())
    assert session.frames[-1].pace.phase == "paused" and session.frames[-1].paths is None
    session.tick(session.time)
    paths = session.frames[-1].paths
    assert paths is not None
    np.testing.assert_array_equal(paths.intact, intact())


def test_a_replay_that_does_not_go_on_asks_for_no_time() -> None:
    session = in_mid_replay(SetCamera("first", OFF))
    assert once(session, SetAutoNext(False), SetSpeed(None)) is None
    assert session._stage.retracing, "it goes on at another speed"


def test_paths_of_two_lengths_are_compared_as_far_as_both_go() -> None:
    paths = HandPaths(3, np.zeros((3, 3), np.float32), np.ones((5, 3), np.float32))
    assert paths.apart.shape == (3,) and paths.differ_at == 3


def test_a_camera_that_is_moved_meanwhile_is_drawn_at_the_end_of_the_episode() -> None:
    session = in_mid_replay(SetCamera("first", OFF))
    once(session, MoveCamera("third_a", Displacement(pan=20)))
    assert not session._stage.retracing and session.frames[-1].paths is None
    done = Recorder()
    done.tick(0.0)
    done.ask(SetCamera("first", OFF))
    done.steps(LAST)
    moved = done.ask(MoveCamera("third_a", Displacement(pan=20)))
    for frame in (session.frames[-1], moved):
        drawn = frame.world.views["third_a"].rgb
        np.testing.assert_array_equal(drawn, moved.world.views["third_a"].rgb)
    assert moved.paths is not None, "they stay"


def test_an_episode_that_begins_in_mid_replay_has_its_cameras_in_their_places() -> None:
    move = MoveCamera("third_a", Displacement(pan=20))
    session = in_mid_replay(move)
    once(session, Reset())
    fresh = Recorder()
    fresh.tick(0.0)
    drawn = fresh.ask(move).world.views["third_a"].rgb
    np.testing.assert_array_equal(session.frames[-1].world.views["third_a"].rgb, drawn)
    assert session.frames[-1].paths is None


def test_an_episode_without_a_change_is_not_replayed() -> None:
    session = Recorder()
    assert session.steps(LAST).paths is None
    session.ask(SetCamera("first", OFF))
    assert session.frames[-1].paths is None, "the episode was over"


def test_full_speed_waits_for_no_replay() -> None:
    session = Recorder(speed=None)
    session.ask(SetCamera("first", OFF))
    assert session.steps(LAST).paths is None


def test_another_policy_in_the_episode_ends_the_comparison() -> None:
    session = Recorder()
    session.ask(SetCamera("first", OFF))
    session.steps(3)
    session.ask(SetPolicy("toy-other"))
    assert session.steps(LAST - 3).paths is None


def test_another_future_has_paths_of_its_own() -> None:
    session = Recorder()
    session.steps(6)
    session.ask(SetCamera("first", OFF))
    session.steps(LAST - 6)
    session.ask(Scrub(2), SetCamera("third_a", OFF), Play())
    assert session.frames[-1].paths is None
    paths = session.steps(LAST - 3).paths
    assert paths is not None and paths.since == 2
    np.testing.assert_array_equal(paths.intact, intact()[2:])


def test_bs_episode_keeps_its_path_when_a_goes_back() -> None:
    session = Recorder()
    session.ask(Compare("toy-other"))
    session.steps(6)
    session.ask(SetCamera("first", OFF))
    ended = session.steps(LAST - 6)
    session.ask(Scrub(2), Fork(), Play())
    again = session.steps(LAST - 3)
    before, after = (frame.second.paths for frame in (ended, again) if frame.second is not None)
    assert before is not None and after is not None and after.since == before.since == 6
    np.testing.assert_array_equal(after.intact, before.intact)


class Drifts(ToyReach):
    """Not the same episode twice."""

    count = 0

    def reset(self, seed: int) -> TimeStep:
        self.count += 1
        return super().reset(seed + self.count)


class Moody(FakePolicy):
    """Acts on something that no seed fixes."""

    count = 0

    def read(self, encoded: Encoded, masks: Any) -> Readout:
        self.count += 1
        readout = super().read(encoded, masks)
        readout.action[:] += 1e-6 * self.count
        return readout


@pytest.mark.parametrize("at", [0, 4])
@pytest.mark.parametrize(
    "policy, env", [(FakePolicy(), Drifts), (Moody(), ToyReach)], ids=["episode", "policy"]
)
def test_nothing_is_said_where_the_replay_is_not_exact(at: int, policy: FakePolicy, env) -> None:
    session = Recorder(policy, lambda task, profile, cameras: env("reach", profile, cameras))
    session.tick(0.0)
    if at:
        session.steps(at)
    session.ask(SetCamera("first", OFF))
    frame = session.steps(LAST - at)
    assert frame.ended and frame.pace.error == ""
    assert frame.paths is None
    words = ending_of(frame, measured)
    assert words is not None and words.came_of_it == ""


def test_a_served_policy_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("madviz.session.retrace.ServedPolicy", FakePolicy)
    session = Recorder()
    session.ask(SetCamera("first", OFF))
    session.steps(LAST)
    assert Retrace(session._stage._live, session._stage._live.snapshot()).done
    assert session.frames[-1].paths is None


def test_an_error_in_a_replay_is_shown_and_is_no_loop() -> None:
    session = in_mid_replay(SetCamera("first", OFF))
    env: Any = session._stage._live.env

    def view(camera: str) -> None:
        raise RuntimeError("no picture")

    env.view = view
    assert once(session) is None, "it has paused"
    assert "no picture" in session.frames[-1].pace.error
    assert not session._stage.retracing


def test_how_far_the_paths_are_apart_and_from_where_on() -> None:
    straight = np.zeros((5, 3), np.float32)
    bent = straight.copy()
    bent[2:, 0] = [0.004, 0.03, 0.02]
    paths = HandPaths(10, bent, straight)
    assert paths.largest == pytest.approx(0.03) and paths.differ_at == 13
    assert HandPaths(10, bent[:3], straight[:3]).differ_at is None
    bent[1, 1] = APART + 1e-6
    assert paths.differ_at == 11


def test_paths_reach_the_page_once() -> None:
    session = Recorder()
    session.ask(SetCamera("first", OFF))
    session.steps(LAST)
    first, second = session.frames[-1], session.ask(Pause())
    encoder, decoder = FrameEncoder(), FrameDecoder()
    one, two = (decoder.decode(encoder.encode(frame)) for frame in (first, second))
    assert one.paths is two.paths is not None  # type: ignore[union-attr]
