"""What a session shows of the past, and the futures that begin in it."""

from __future__ import annotations

import numpy as np

from madviz.envs.toy import ToyReach
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.schedule import Event
from madviz.session.commands import (
    Compare,
    Fork,
    Link,
    Play,
    Scrub,
    SetCamera,
    SetSchedule,
    StepOnce,
)
from tests.fakes import Silent
from tests.sessions import OFF, Recorder


def test_curves_and_cosines(session: Recorder):
    frame = session.frames[-1]
    cosines = frame.world.probe.cosines(frame.row)
    features, merged = frame.world.probe.features, frame.world.probe.features.sum(0)
    expected = features @ merged / np.linalg.norm(features, axis=1) / np.linalg.norm(merged)
    np.testing.assert_allclose(cosines, expected, rtol=1e-4)
    np.testing.assert_allclose(frame.world.probe.norms, np.linalg.norm(features, axis=1), rtol=1e-5)
    assert np.isnan(frame.world.probe.cosines(frame.world.probe.row(np.zeros(3, bool)))).all()


def test_the_past_is_shown_as_it_was(session: Recorder):
    before = session.steps(6)
    session.ask(SetCamera("first", OFF))
    session.steps(4)
    live = session.frames[-1]
    then = session.ask(Scrub(6))
    assert (then.world.step, then.past, then.pace.phase, len(then.history)) == (
        6,
        True,
        "paused",
        11,
    )
    assert then.condition.subset == "third_a+third_b"  # What the step ended with.
    assert np.array_equal(then.world.views["first"].rgb, before.world.views["first"].rgb)
    assert session.tick(1e9) is None  # Nothing moves while somebody looks back.
    back = session.ask(Scrub(None))
    assert (back.world.step, back.past) == (10, False)
    assert np.array_equal(back.action, live.action)
    assert session.ask(Scrub(99)).world.step == 10


def test_a_fork_without_a_change_repeats_the_first_future(session: Recorder):
    session.ask(SetCamera("third_a", CameraState("rgb", Occlusion("noise", 0.5))))
    session.steps(5)
    session.ask(SetCamera("third_b", CameraState("rgb", Occlusion("freeze"))))
    session.steps(20)
    first = {f.world.step: f for f in session.frames}
    assert len(session.frames[-1].world.outcomes) == 1
    session.ask(Scrub(9))
    forked = session.ask(Fork())
    assert (forked.world.step, forked.past, forked.pace.phase) == (9, False, "playing")
    assert forked.branch is not None
    assert (forked.branch.at, forked.branch.frame.world.step) == (9, 9)
    for step in range(10, 26):
        frame = session.steps(1) if session.frames[-1].world.step < step else session.frames[-1]
        assert frame.branch is not None
        assert frame.world.step == step and frame.branch.frame.world.step == step
        assert np.array_equal(frame.action, first[step].action)
        assert frame.world.reward == first[step].world.reward
        assert frame.world.total_reward == first[step].world.total_reward
        for stream, picture in frame.world.arrived.items():
            assert np.array_equal(picture, first[step].world.arrived[stream])


def test_touching_a_camera_in_the_past_begins_another_future(session: Recorder):
    session.steps(12)
    first = {f.world.step: f for f in session.frames}
    session.ask(Scrub(4))
    frame = session.ask(SetCamera("first", OFF))
    assert (frame.world.step, frame.past, frame.pace.phase) == (4, False, "paused")
    assert frame.world.change is not None and len(frame.history) == 5
    session.ask(Play())
    later = session.steps(3)
    assert later.branch is not None
    assert len(later.branch.history) == 13 and later.branch.at == 4
    assert later.branch.frame.world.step == later.world.step
    assert not np.array_equal(later.action, first[later.world.step].action)
    assert later.condition.subset == "third_a+third_b"


def test_a_preview_leaves_no_trace_in_the_past(session: Recorder):
    session.steps(3)
    plain = session.frames[-1]
    session.send(SetCamera("first", OFF))
    session.steps(2)  # The command came first thing in a tick, and counts from step 3 on.
    then = session.ask(Scrub(2))
    assert then.condition.subset == "all" and plain.condition.subset == "all"
    assert session.ask(Scrub(3)).condition.subset == "third_a+third_b"


def test_forking_needs_a_past(session: Recorder):
    session.steps(2)
    frame = session.ask(Fork())
    assert frame.pace.error.startswith("expected an earlier step") and frame.pace.phase == "paused"


def test_a_preview_leaves_the_history_of_the_step_it_shows():
    class Slow(ToyReach):
        drawn = 0

        def view(self, camera, size=None):
            Slow.drawn += 1
            if Slow.drawn == 5:  # The second camera of the first step.
                session.send(SetCamera("first", OFF))
            return super().view(camera, size)

    session = Recorder(env_factory=lambda *_: Slow())
    session.at(0.0)
    session.at(0.1)
    preview, arrived = session.frames[-2:]
    assert [one.condition.subset for one in preview.history] == ["third_a+third_b"]
    assert [one.condition.subset for one in arrived.history] == ["all", "third_a+third_b"]
    then = session.ask(Scrub(0))
    assert then.condition == then.history[0].condition


def test_what_is_no_part_of_a_step_is_as_it_is_now_while_looking_back(session: Recorder):
    session.ask(Compare("toy-mad"))
    assert len(session.steps(25).pairs) == 1
    then = session.ask(Scrub(3))
    assert then.past and then.second is None
    assert len(then.pairs) == len(then.world.outcomes) == 1
    later = (Event(20, "first", dropped=True),)
    then = session.ask(Link(False), SetSchedule(later))
    assert (then.world.step, then.schedule, then.linked) == (3, later, False)


def test_a_step_whose_second_side_fails_is_still_in_the_past():
    second = Silent("toy-silent")
    session = Recorder(load=lambda _: second)
    session.at(0.0)
    session.ask(Compare("toy-silent"))
    for step in (1, 2, 3):
        second.silent = True
        frame = session.ask(StepOnce())
        assert "found none" in frame.pace.error
        assert (frame.world.step, len(frame.history)) == (step, step + 1)
        second.silent = False
        frame = session.ask(StepOnce())  # The rest of that step.
        assert frame.second is not None and not frame.pace.error
        assert frame.world.step == frame.second.world.step == step
    assert [session.ask(Scrub(step)).world.step for step in (1, 2, None)] == [1, 2, 3]
