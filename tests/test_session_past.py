"""What a session shows of the past, and the futures that begin in it."""

from __future__ import annotations

import numpy as np

from madviz.observation.ablation import CameraState, Occlusion
from madviz.session.commands import Fork, Play, Scrub, SetCamera
from tests.sessions import OFF


def test_curves_and_cosines(session):
    frame = session.frames[-1]
    cosines = frame.probe.cosines(frame.row)
    features, merged = frame.probe.features, frame.probe.features.sum(0)
    expected = features @ merged / np.linalg.norm(features, axis=1) / np.linalg.norm(merged)
    np.testing.assert_allclose(cosines, expected, rtol=1e-4)
    np.testing.assert_allclose(frame.probe.norms, np.linalg.norm(features, axis=1), rtol=1e-5)
    assert np.isnan(frame.probe.cosines(frame.probe.row(np.zeros(3, bool)))).all()


def test_the_past_is_shown_as_it_was(session):
    before = session.steps(6)
    session.ask(SetCamera("first", OFF))
    session.steps(4)
    live = session.frames[-1]
    then = session.ask(Scrub(6))
    assert (then.step, then.past, then.phase, len(then.story)) == (6, True, "paused", 11)
    assert then.setting.subset == "third_a+third_b"  # What the step ended with.
    assert np.array_equal(then.views["first"].rgb, before.views["first"].rgb)
    assert session.tick(1e9) is None  # Nothing moves while somebody looks back.
    back = session.ask(Scrub(None))
    assert (back.step, back.past) == (10, False)
    assert np.array_equal(back.action, live.action)
    assert session.ask(Scrub(99)).step == 10


def test_a_fork_without_a_change_repeats_the_first_future(session):
    session.ask(SetCamera("third_a", CameraState("rgb", Occlusion("noise", 0.5))))
    session.steps(5)
    session.ask(SetCamera("third_b", CameraState("rgb", Occlusion("freeze"))))
    session.steps(20)
    first = {f.step: f for f in session.frames}
    assert len(session.frames[-1].outcomes) == 1
    session.ask(Scrub(9))
    forked = session.ask(Fork())
    assert (forked.step, forked.past, forked.phase) == (9, False, "playing")
    assert forked.branch is not None and (forked.branch.at, forked.branch.frame.step) == (9, 9)
    for step in range(10, 26):
        frame = session.steps(1) if session.frames[-1].step < step else session.frames[-1]
        assert frame.step == step and frame.branch.frame.step == step
        assert np.array_equal(frame.action, first[step].action)
        assert frame.reward == first[step].reward
        assert frame.total_reward == first[step].total_reward
        for stream, picture in frame.arrived.items():
            assert np.array_equal(picture, first[step].arrived[stream])


def test_touching_a_camera_in_the_past_begins_another_future(session):
    session.steps(12)
    first = {f.step: f for f in session.frames}
    session.ask(Scrub(4))
    frame = session.ask(SetCamera("first", OFF))
    assert (frame.step, frame.past, frame.phase) == (4, False, "paused")
    assert frame.change is not None and len(frame.story) == 5
    session.ask(Play())
    later = session.steps(3)
    assert len(later.branch.story) == 13 and later.branch.at == 4
    assert later.branch.frame.step == later.step
    assert not np.array_equal(later.action, first[later.step].action)
    assert later.setting.subset == "third_a+third_b"


def test_a_preview_leaves_no_trace_in_the_past(session):
    session.steps(3)
    plain = session.frames[-1]
    session.send(SetCamera("first", OFF))
    session.steps(2)  # The command came first thing in a tick, and counts from step 3 on.
    then = session.ask(Scrub(2))
    assert then.setting.subset == "all" and plain.setting.subset == "all"
    assert session.ask(Scrub(3)).setting.subset == "third_a+third_b"


def test_forking_needs_a_past(session):
    session.steps(2)
    frame = session.ask(Fork())
    assert frame.error.startswith("expected an earlier step") and frame.phase == "paused"
