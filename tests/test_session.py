"""The session with an injected clock and a fake policy: no test sleeps."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from madviz.ablations import Ablation, CameraState, Occlusion
from madviz.envs.base import make_env
from madviz.envs.toy import ToyReach
from madviz.session.commands import (
    Fork,
    Pause,
    Play,
    Reset,
    Scrub,
    SetAutoNext,
    SetCamera,
    SetPolicy,
    SetSeed,
    SetSpeed,
    SetTwin,
    StepOnce,
)
from madviz.session.frame import Failure, Frame, words
from madviz.session.session import FIRST_SEED, HOLD, Session
from madviz.session.simulation import Simulation, inhabited
from madviz.types import UserError
from tests.fakes import AllOrNothing, FakePolicy, policies

OFF = CameraState("off")
BLACK = CameraState("rgb", occlusion=Occlusion("black"))


class Recorder(Session):
    """A session that keeps its frames, on a clock the test moves."""

    def __init__(self, policy=None, env_factory=make_env, **kwargs) -> None:
        super().__init__(env_factory, policy or FakePolicy(), policies, **kwargs)
        self.frames: list[Frame] = []
        self.subscribe(lambda frame: self.frames.append(frame))  # type: ignore[arg-type]
        self.time = 0.0

    def at(self, time: float) -> float | None:
        self.time = time
        return self.tick(time)

    def steps(self, count: int) -> Frame:
        """Lets ``count`` due moments pass."""
        for _ in range(count):
            due = self.tick(self.time)
            assert due is not None
            self.time = max(self.time, due)
            self.tick(self.time)
        return self.frames[-1]

    def ask(self, *commands) -> Frame:
        for command in commands:
            self.send(command)
        self.tick(self.time)
        return self.frames[-1]


@pytest.fixture
def session() -> Recorder:
    recorder = Recorder()
    recorder.at(0.0)
    return recorder


def test_first_tick_starts_an_episode(session):
    frame = session.frames[-1]
    assert (frame.seed, frame.step, frame.episode, frame.phase) == (FIRST_SEED, 0, 1, "playing")
    assert set(frame.views) == {"first", "third_a", "third_b"}
    assert frame.probe.masks.shape == (8, 3)
    assert frame.setting.subset == "all"


def test_steps_come_at_the_asked_pace(session):
    assert session.at(0.05) == pytest.approx(0.1)
    assert session.frames[-1].step == 0
    assert session.at(0.1) == pytest.approx(0.2)
    assert session.frames[-1].step == 1


def test_achieved_rate_is_measured(session):
    session.ask(SetSpeed(8.0))  # Eighths of a second are exact in binary.
    for eighth in range(10):
        session.at(eighth / 8)
    assert session.frames[-1].rate == pytest.approx(8)
    assert not session.frames[-1].behind


def test_a_slow_machine_is_called_behind_and_its_debt_is_forgiven(session):
    for quarter in range(1, 10):
        due = session.at(quarter / 4)
    assert session.frames[-1].rate == pytest.approx(4)
    assert session.frames[-1].behind
    assert due == pytest.approx(9 / 4)
    assert session.frames[-1].step == 9


def test_an_ended_episode_holds_then_the_next_seed_starts(session):
    frame = session.steps(25)
    assert (frame.phase, frame.step, frame.ended) == ("ended", 25, True)
    assert session.at(session.time + HOLD / 2) == pytest.approx(session.time + HOLD / 2)
    assert session.frames[-1].step == 25
    session.at(session.time + HOLD)
    assert (session.frames[-1].seed, session.frames[-1].step) == (FIRST_SEED + 1, 0)
    outcome = session.frames[-1].outcomes[0]
    assert outcome.seed == FIRST_SEED
    assert outcome.setting is not None and outcome.setting.subset == "all"
    assert set(outcome.cameras.values()) == {""}


def test_without_auto_next_an_ended_episode_stays_until_asked(session):
    session.ask(SetAutoNext(False))
    session.steps(25)
    assert session.at(1000.0) is None
    assert session.frames[-1].phase == "ended"
    assert session.ask(Reset()).seed == FIRST_SEED
    assert session.frames[-1].phase == "playing"
    session.steps(25)
    assert session.ask(Play()).seed == FIRST_SEED + 1


def test_pause_step_and_seed(session):
    assert session.ask(Pause()).phase == "paused"
    assert session.at(9.0) is None
    assert session.ask(StepOnce()).step == 1
    assert session.frames[-1].phase == "paused"
    assert session.ask(SetSeed(7)).seed == 7
    assert session.ask(Play()).phase == "playing"
    assert session.ask(Reset(next_seed=True)).seed == 8


def test_pause_holds_an_ended_episode(session):
    session.steps(25)
    assert session.ask(Pause()).phase == "paused"
    assert session.at(session.time + 10 * HOLD) is None
    assert session.frames[-1].ended
    assert session.ask(Play()).seed == FIRST_SEED + 1
    assert session.frames[-1].phase == "playing"


def test_a_dropped_camera_leaves_the_sum_at_once(session):
    session.steps(3)
    before = session.frames[-1]
    after = session.ask(SetCamera("third_a", OFF))
    assert after.step == before.step and after.number > before.number
    assert after.setting.subset == "first+third_b"
    kept = after.probe.features[[0, 2]].sum(0)
    np.testing.assert_allclose(after.probe.readout.merged[after.row], kept, rtol=1e-5)
    np.testing.assert_array_equal(after.arrived["third_a"], before.arrived["third_a"])
    change = after.change
    assert change is not None
    assert change.action_change == pytest.approx(
        float(np.linalg.norm(after.action - before.action))
    )
    assert words(change, after.env).startswith("Third A dropped: action changed by ")
    session.steps(1)
    assert not session.frames[-1].mask[1]


def test_black_is_not_dropped(session):
    dropped = session.ask(SetCamera("third_a", OFF))
    session.ask(SetCamera("third_a", CameraState("rgb")))
    black = session.ask(SetCamera("third_a", BLACK))
    assert black.setting.subset == "all" and "third_a:black" in black.setting.occlusions
    assert (black.arrived["third_a"] == 0).all()
    assert dropped.arrived["third_a"].any()
    assert "sends black" in words(black.change, black.env)


def test_camera_commands_are_served_between_renders():
    class Slow(ToyReach):
        drawn = 0

        def view(self, camera, size=None):
            Slow.drawn += 1
            if Slow.drawn == 5:  # The second camera of the first step.
                session.send(SetCamera("first", OFF))
                session.send(Pause())
            return super().view(camera, size)

    session = Recorder(env_factory=lambda task, profile, cameras: Slow())
    session.at(0.0)
    session.at(0.1)
    preview, arrived = session.frames[-2:]
    assert (preview.step, preview.setting.subset) == (0, "third_a+third_b")
    assert (arrived.step, arrived.setting.subset) == (1, "third_a+third_b")
    assert arrived.phase == "playing"
    session.at(0.11)
    assert session.frames[-1].phase == "paused"


def test_a_preview_leaves_no_trace_in_what_the_policy_gets():
    """Touching a camera while step 1 is drawn equals touching it once step 1 has arrived."""

    class Early(ToyReach):
        drawn = 0

        def view(self, camera, size=None):
            Early.drawn += 1
            if Early.drawn == 5:
                early.send(SetCamera("first", BLACK))
            return super().view(camera, size)

    early = Recorder(env_factory=lambda task, profile, cameras: Early())
    late = Recorder()
    for session in (early, late):
        session.at(0.0)
        session.at(0.1)
    late.ask(SetCamera("first", BLACK))
    for _ in range(4):
        left, right = early.steps(1), late.steps(1)
        np.testing.assert_array_equal(left.probe.features, right.probe.features)
        np.testing.assert_array_equal(left.action, right.action)


def test_same_seed_and_commands_give_the_same_episode():
    def episode() -> list[Frame]:
        session = Recorder(seed=31)
        session.at(0.0)
        noise = CameraState(occlusion=Occlusion("noise", 0.7))
        session.steps(4)
        session.ask(SetCamera("third_b", noise))
        session.steps(5)
        session.ask(SetCamera("first", OFF))
        session.steps(10)
        return session.frames

    for left, right in zip(episode(), episode(), strict=True):
        np.testing.assert_array_equal(left.action, right.action)
        np.testing.assert_array_equal(left.arrived["third_b"], right.arrived["third_b"])


def test_outcomes_remember_what_was_wrong(session):
    session.ask(SetSpeed(None), SetCamera("first", OFF))
    session.steps(3)
    session.ask(SetCamera("first", CameraState("rgb")), SetCamera("third_b", BLACK))
    session.steps(30)
    outcome = session.frames[-1].outcomes[0]
    assert outcome.cameras == {"first": "off", "third_a": "", "third_b": "occluded"}
    assert outcome.setting is None


def test_nan_action_pauses_with_a_traceback_and_reset_recovers(session):
    session.ask(SetPolicy("toy-nan"))
    session.ask(SetCamera("first", OFF), SetCamera("third_a", OFF))
    assert not session.frames[-1].error
    broken = session.steps(1)
    assert broken.phase == "paused"
    assert "finite action" in broken.error and "Traceback" in broken.error
    assert session.at(session.time + 5) is None
    session.ask(SetCamera("first", CameraState("rgb")))
    well = session.ask(Reset())
    assert (well.error, well.phase, well.step) == ("", "playing", 0)
    assert session.steps(2).step == 2


def test_a_policy_that_needs_every_stream_says_so():
    session = Recorder(AllOrNothing("toy-stack"))
    session.at(0.0)
    session.ask(SetCamera("first", OFF))
    assert np.isnan(session.frames[-1].action).all()
    assert "cannot act on 'third_a+third_b'" in session.steps(1).error
    session.ask(SetCamera("first", CameraState("rgb")), Play())
    assert session.steps(1).error == ""


def test_policies_swap_in_mid_episode_and_camera_settings_stay(session):
    session.ask(SetCamera("third_a", OFF))
    before = session.steps(5)
    after = session.ask(SetPolicy("toy-other"))
    assert (after.policy.name, after.step) == ("toy-other", before.step)
    assert after.setting.subset == "first+third_b"
    np.testing.assert_array_equal(after.arrived["first"], before.arrived["first"])
    six = session.ask(SetPolicy("toy-rgbd"))
    assert six.probe.masks.shape == (64, 6)
    assert six.setting.subset == "first+third_b"
    assert session.steps(2).step == before.step + 2


def test_an_unknown_policy_leaves_the_old_one(session):
    frame = session.ask(SetPolicy("nonsense"))
    assert frame.policy.name == "toy-mad" and "nonsense" in frame.error
    assert session.ask(Play()).error == ""


def test_a_policy_may_come_by_its_name():
    session = Recorder("toy-other")
    assert session.latest is None
    session.at(0.0)
    assert session.frames[-1].policy.name == "toy-other"


def test_a_name_that_nobody_knows_is_said_and_another_policy_helps():
    session = Recorder("nonsense")
    session.at(0.0)
    assert isinstance(session.latest, Failure) and "unknown policy" in session.latest.error
    session.ask(SetPolicy("toy-other"))
    assert session.frames[-1].policy.name == "toy-other"


def test_a_policy_of_another_world_is_refused_and_the_old_one_stays():
    def odd(name: str) -> FakePolicy:
        policy = policies("toy-other")
        policy.spec = replace(policy.spec, state_dim=24)
        return policy

    session = Recorder()
    session.at(0.0)
    session._stage._load = odd
    for command in (SetPolicy("toy-other"), SetTwin("toy-other")):
        frame = session.ask(command)
        assert "state numbers = 24, this environment has 6" in frame.error
        assert frame.policy.name == "toy-mad" and frame.twin is None


def test_a_swapped_policy_gets_the_past_it_would_have_had():
    swapped, fresh = Recorder(), Recorder(policies("toy-rgbd"))
    for session in (swapped, fresh):
        session.at(0.0)
        session.ask(SetAutoNext(False))
    action = np.zeros(2, np.float32)
    for session in (swapped, fresh):
        # The same actions for both, so that only the policy's past can differ.
        simulation = session._stage.simulation
        assert simulation is not None
        for _ in range(6):
            simulation.probe.readout.action[:] = action
            simulation.step(lambda: None)
    after = swapped.ask(SetPolicy("toy-rgbd"))
    expected = fresh.ask(Pause())
    np.testing.assert_array_equal(after.probe.features, expected.probe.features)


def test_a_simulator_that_cannot_start_is_reported_and_can_be_retried():
    attempts = []

    def factory(task, profile, cameras):
        attempts.append(task)
        if len(attempts) == 1:
            raise UserError("no OpenGL here")
        return make_env(task, profile)

    session = Recorder(env_factory=factory)
    assert session.at(0.0) is None
    assert isinstance(session.latest, Failure) and "no OpenGL here" in session.latest.error
    assert session.at(1.0) is None and len(attempts) == 1
    assert session.ask(Play()).step == 0


def test_unknown_camera_is_an_error_the_page_survives(session):
    frame = session.ask(SetCamera("fourth", OFF))
    assert "unknown camera 'fourth'" in frame.error
    assert session.ask(Play()).error == ""


@pytest.mark.parametrize("rate", [0.0, -1.0, 1e9, float("nan")])
def test_absurd_speeds_are_refused(rate):
    with pytest.raises(UserError, match="speed"):
        SetSpeed(rate)


def test_thread_closes_its_environment():
    closed = []

    class Closing(ToyReach):
        def close(self):
            closed.append(True)

    session, opened = Session(lambda *_: Closing(), FakePolicy(), speed=None), threading.Event()
    session.subscribe(lambda _: opened.set())
    session.start()
    assert opened.wait(60)  # One that was never opened has nothing to close.
    session.close()
    assert closed == [True]
    assert session._thread is not None and not session._thread.is_alive()


def test_a_session_closed_in_mid_step_ends_though_it_is_paused():
    """What wakes it from its wait is read in mid-step, with the commands about cameras."""
    drawing, go_on = threading.Event(), threading.Event()

    class Slow(ToyReach):
        def step(self, action):
            drawing.set()
            assert go_on.wait(60)
            return super().step(action)

    session, opened = Session(lambda *_: Slow(), FakePolicy(), speed=0.1), threading.Event()
    session.subscribe(lambda _: opened.set())
    session.send(Pause())
    session.start()
    assert opened.wait(60)
    session.send(StepOnce())
    assert drawing.wait(60)
    session.close(timeout=0.0)
    go_on.set()
    assert session._thread is not None
    session._thread.join(20)
    assert not session._thread.is_alive()


def test_what_cannot_be_shown_still_ends_with_its_environment_closed(monkeypatch):
    """Every picture fails, even that of the failure; so does one of those who listen."""
    closed, told = [], threading.Event()

    class Closing(ToyReach):
        def close(self):
            closed.append(True)

    def blind(*_, **__):
        raise RuntimeError("no picture today")

    def deaf(_):
        raise RuntimeError("not listening")

    session = Session(lambda *_: Closing(), FakePolicy(), speed=None)
    monkeypatch.setattr(session._stage, "frame", blind)
    session.subscribe(deaf)
    session.subscribe(lambda _: told.set())
    session.start()
    assert told.wait(60)
    assert isinstance(session.latest, Failure) and "no picture today" in session.latest.error
    session.send(Play())
    session.close()
    assert session._thread is not None and not session._thread.is_alive()
    assert closed == [True]


def test_a_policy_that_cannot_live_in_its_environment_leaves_none_open(monkeypatch):
    closed = []

    class Closing(ToyReach):
        def close(self):
            closed.append(True)

    def broken(*_):
        raise RuntimeError("no place for it")

    monkeypatch.setattr(Simulation, "_adopt", broken)
    with pytest.raises(RuntimeError, match="no place for it"):
        inhabited(Closing(), FakePolicy(), Ablation())
    assert closed == [True]


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
