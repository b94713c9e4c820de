"""The session with an injected clock and a fake policy: no test sleeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from madviz.envs.toy import ToyReach
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.schedule import Event
from madviz.session.commands import (
    Command,
    Compare,
    Pause,
    Play,
    Reset,
    SetAutoNext,
    SetCamera,
    SetPolicy,
    SetSchedule,
    SetSeed,
    SetSpeed,
    StepOnce,
)
from madviz.session.frame import Frame, deed, words
from madviz.session.pace import HOLD
from madviz.session.session import FIRST_SEED
from tests.fakes import AllOrNothing
from tests.sessions import BLACK, OFF, Recorder


def test_first_tick_starts_an_episode(session: Recorder):
    frame = session.frames[-1]
    assert (frame.world.seed, frame.world.step, frame.world.episode, frame.pace.phase) == (
        FIRST_SEED,
        0,
        1,
        "playing",
    )
    assert set(frame.world.views) == {"first", "third_a", "third_b"}
    assert frame.world.probe.masks.shape == (8, 3)
    assert frame.condition.subset == "all"


def test_steps_come_at_the_asked_pace(session: Recorder):
    assert session.at(0.05) == pytest.approx(0.1)
    assert session.frames[-1].world.step == 0
    assert session.at(0.1) == pytest.approx(0.2)
    assert session.frames[-1].world.step == 1


def test_achieved_rate_is_measured(session: Recorder):
    session.ask(SetSpeed(8.0))  # Eighths of a second are exact in binary.
    for eighth in range(10):
        session.at(eighth / 8)
    assert session.frames[-1].pace.rate == pytest.approx(8)
    assert not session.frames[-1].behind


def test_a_slow_machine_is_called_behind_and_its_debt_is_forgiven(session: Recorder):
    for quarter in range(1, 10):
        due = session.at(quarter / 4)
    assert session.frames[-1].pace.rate == pytest.approx(4)
    assert session.frames[-1].behind
    assert due == pytest.approx(9 / 4)
    assert session.frames[-1].world.step == 9


def test_an_ended_episode_holds_then_the_next_seed_starts(session: Recorder):
    frame = session.steps(25)
    assert (frame.pace.phase, frame.world.step, frame.ended) == ("ended", 25, True)
    assert session.at(session.time + HOLD / 2) == pytest.approx(session.time + HOLD / 2)
    assert session.frames[-1].world.step == 25
    session.at(session.time + HOLD)
    assert (session.frames[-1].world.seed, session.frames[-1].world.step) == (FIRST_SEED + 1, 0)
    outcome = session.frames[-1].world.outcomes[0]
    assert outcome.seed == FIRST_SEED
    assert outcome.condition is not None and outcome.condition.subset == "all"
    assert set(outcome.cameras.values()) == {""}


def test_without_auto_next_an_ended_episode_stays_until_asked(session: Recorder):
    session.ask(SetAutoNext(False))
    session.steps(25)
    assert session.at(1000.0) is None
    assert session.frames[-1].pace.phase == "ended"
    assert session.ask(Reset()).world.seed == FIRST_SEED
    assert session.frames[-1].pace.phase == "playing"
    session.steps(25)
    assert session.ask(Play()).world.seed == FIRST_SEED + 1


def test_pause_step_and_seed(session: Recorder):
    assert session.ask(Pause()).pace.phase == "paused"
    assert session.at(9.0) is None
    assert session.ask(StepOnce()).world.step == 1
    assert session.frames[-1].pace.phase == "paused"
    assert session.ask(SetSeed(7)).world.seed == 7
    assert session.ask(Play()).pace.phase == "playing"
    assert session.ask(Reset(next_seed=True)).world.seed == 8


def test_pause_holds_an_ended_episode(session: Recorder):
    session.steps(25)
    assert session.ask(Pause()).pace.phase == "paused"
    assert session.at(session.time + 10 * HOLD) is None
    assert session.frames[-1].ended
    assert session.ask(Play()).world.seed == FIRST_SEED + 1
    assert session.frames[-1].pace.phase == "playing"


def test_a_dropped_camera_leaves_the_sum_at_once(session: Recorder):
    session.steps(3)
    before = session.frames[-1]
    after = session.ask(SetCamera("third_a", OFF))
    assert after.world.step == before.world.step and after.pace.number > before.pace.number
    assert after.condition.subset == "first+third_b"
    kept = after.world.probe.features[[0, 2]].sum(0)
    np.testing.assert_allclose(after.world.probe.readout.merged[after.row], kept, rtol=1e-5)
    np.testing.assert_array_equal(after.world.arrived["third_a"], before.world.arrived["third_a"])
    change = after.world.change
    assert change is not None
    assert change.action_change == pytest.approx(
        float(np.linalg.norm(after.action - before.action))
    )
    assert words(change, after.world.env).startswith("Third A dropped: action changed by ")
    session.steps(1)
    assert not session.frames[-1].mask[1]


def test_what_was_done_to_a_dropped_camera_is_said(session: Recorder):
    said = []
    for state in (OFF, OFF, replace(OFF, occlusion=Occlusion("black")), CameraState("rgb")):
        frame = session.ask(SetCamera("first", state))
        assert frame.world.change is not None
        said.append(deed(frame.world.change, frame.world.env).removeprefix("First person "))
    assert said == ["dropped", "dropped", "sends black", "is back"]


def test_a_camera_that_is_set_as_it_is_makes_no_change(session: Recorder) -> None:
    session.steps(2)
    assert session.ask(SetCamera("first", CameraState("rgb"))).world.change is None
    off = session.ask(SetCamera("first", OFF)).world.change
    assert off is not None and session.ask(SetCamera("first", OFF)).world.change is off


def test_a_camera_that_comes_back_broken_is_not_back(session: Recorder) -> None:
    session.ask(SetCamera("first", OFF))
    frame = session.ask(SetCamera("first", BLACK))
    assert frame.world.change is not None
    assert deed(frame.world.change, frame.world.env) == "First person sends black"


def test_black_is_not_dropped(session: Recorder):
    dropped = session.ask(SetCamera("third_a", OFF))
    session.ask(SetCamera("third_a", CameraState("rgb")))
    black = session.ask(SetCamera("third_a", BLACK))
    assert black.condition.subset == "all" and "third_a:black" in black.condition.key()
    assert (black.world.arrived["third_a"] == 0).all()
    assert dropped.world.arrived["third_a"].any()
    assert black.world.change is not None
    assert "sends black" in words(black.world.change, black.world.env)


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
    assert (preview.world.step, preview.condition.subset) == (0, "third_a+third_b")
    assert (arrived.world.step, arrived.condition.subset) == (1, "third_a+third_b")
    assert arrived.pace.phase == "playing"
    session.at(0.11)
    assert session.frames[-1].pace.phase == "paused"


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
        np.testing.assert_array_equal(left.world.probe.features, right.world.probe.features)
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
        np.testing.assert_array_equal(left.world.arrived["third_b"], right.world.arrived["third_b"])


def test_outcomes_remember_what_was_wrong(session: Recorder):
    session.ask(SetSpeed(None), SetCamera("first", OFF))
    session.steps(3)
    session.ask(SetCamera("first", CameraState("rgb")), SetCamera("third_b", BLACK))
    session.steps(30)
    outcome = session.frames[-1].world.outcomes[0]
    assert outcome.cameras == {"first": "off", "third_a": "", "third_b": "occluded"}
    assert outcome.condition is None


def test_nan_action_pauses_with_a_traceback_and_reset_recovers(session: Recorder):
    session.ask(SetPolicy("toy-nan"))
    session.ask(SetCamera("first", OFF), SetCamera("third_a", OFF))
    assert not session.frames[-1].pace.error
    broken = session.steps(1)
    assert broken.pace.phase == "paused"
    assert "finite action" in broken.pace.error and "Traceback" in broken.pace.error
    assert session.at(session.time + 5) is None
    session.ask(SetCamera("first", CameraState("rgb")))
    well = session.ask(Reset())
    assert (well.pace.error, well.pace.phase, well.world.step) == ("", "playing", 0)
    assert session.steps(2).world.step == 2


@pytest.mark.parametrize("compared", [False, True])
def test_camera_commands_are_served_while_the_next_episode_begins(compared: bool):
    """It meets the last step of the episode before, and the new one begins with it. Where two
    simulations begin, the second one's reset does not have to be over, either."""

    class Slow(ToyReach):
        def reset_in_pieces(self, seed, between):
            moment = super().reset(seed)
            if seed == 41 and self is worlds[-1]:
                before = len(session.frames)
                session.send(SetCamera("first", OFF))
                between()
                served.append(len(session.frames) - before)
            return moment

    def built(task, profile, cameras):
        worlds.append(Slow())
        return worlds[-1]

    worlds: list[Slow] = []
    served: list[int] = []
    session = Recorder(env_factory=built, seed=40)
    session.at(0.0)
    if compared:
        session.ask(Compare("toy-mad"))
    session.steps(3)
    session.ask(Reset(next_seed=True))
    assert len(worlds) == 1 + compared and served == [1]
    shown = [(f.world.seed, f.world.step, f.condition.subset) for f in session.frames[-2:]]
    assert shown == [(40, 3, "third_a+third_b"), (41, 0, "third_a+third_b")]
    after = session.frames[-1].second
    assert (after is not None) == compared
    assert after is None or after.condition.subset == "third_a+third_b"
    session.steps(2)
    saved = session.save().episodes[-1]
    assert saved.commands == () and saved.start == (SetCamera("first", OFF),)


def test_a_camera_touched_before_the_first_decision_leaves_one_condition(session: Recorder):
    session.ask(SetCamera("first", OFF))
    outcome = session.steps(25).world.outcomes[0]
    assert outcome.condition is not None and outcome.condition.subset == "third_a+third_b"
    assert outcome.cameras == {"first": "off", "third_a": "", "third_b": ""}


def test_what_no_decision_sees_counts_nowhere():
    """A camera that is back before the next decision, and one that goes after the last."""

    class Slow(ToyReach):
        def view(self, camera, size=None):
            if waiting and camera == "third_a":
                session.send(waiting.pop())
            return super().view(camera, size)

    waiting: list[SetCamera] = []
    session = Recorder(env_factory=lambda *_: Slow())
    session.at(0.0)
    session.steps(3)
    session.ask(SetCamera("first", OFF), SetCamera("first", CameraState("rgb")))
    session.steps(21)
    waiting.append(SetCamera("first", OFF))
    frame = session.steps(1)
    assert frame.ended and frame.condition.subset == "third_a+third_b"
    (outcome,) = frame.world.outcomes
    assert outcome.condition is not None and outcome.condition.subset == "all"
    assert set(outcome.cameras.values()) == {""}


def test_a_decision_that_is_refused_leaves_no_condition():
    session = Recorder(AllOrNothing("toy-stack"))
    session.at(0.0)
    session.steps(3)
    session.ask(SetCamera("first", OFF))
    assert "cannot act" in session.steps(1).pace.error
    session.ask(SetCamera("first", CameraState("rgb")), Play())
    (outcome,) = session.steps(22).world.outcomes
    assert outcome.condition is not None and outcome.condition.subset == "all"


def test_a_switch_before_another_command_is_not_lost(session: Recorder):
    """Two states of one camera, with a decision between."""
    session.ask(Pause())
    session.ask(SetCamera("first", OFF), StepOnce(), SetCamera("first", CameraState("rgb")))
    commands = session.save().episodes[-1].commands
    assert [(one.step, one.command) for one in commands] == [
        (0, SetCamera("first", OFF)),
        (1, SetCamera("first", CameraState("rgb"))),
    ]


def test_in_mid_step_no_camera_overtakes_what_comes_before_it():
    class Slow(ToyReach):
        def view(self, camera, size=None):
            while waiting:
                session.send(waiting.pop(0))
            return super().view(camera, size)

    waiting: list[Command] = []
    session = Recorder(env_factory=lambda *_: Slow())
    session.at(0.0)
    session.ask(SetSchedule((Event(0, "first", dropped=True),)))
    waiting += [SetSpeed(5.0), SetCamera("third_a", OFF)]
    waiting += [SetSchedule(()), SetCamera("first", BLACK)]
    arrived = session.steps(1)
    assert arrived.condition.subset == "third_b"
    session.tick(session.time)
    after = session.frames[-1]
    assert after.schedule == () and after.camera("first") == BLACK
