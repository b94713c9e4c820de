"""A policy that takes long for a decision: the visitor is answered meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from madviz.envs.registry import make_env
from madviz.observation.ablation import CameraState
from madviz.session.commands import (
    Pause,
    Play,
    SetCamera,
    SetSeed,
    SetSpeed,
    StepOnce,
)
from madviz.session.frame import Frame, NoFrame
from madviz.session.session import Session
from madviz.session.waiting import PolicyWait, promised
from madviz.types import Array, Encoded, Readout
from tests.fakes import FakePolicy, policies
from tests.pages import await_that
from tests.sessions import OFF, frame_with

RGB = CameraState("rgb")
REACTS = 0.5
"""Seconds in which a switch must be seen."""


class Slow(FakePolicy):
    """Reads one set of cameras at a time, and answers when the test lets it."""

    def __init__(self) -> None:
        super().__init__("toy-slow")
        self.spec = replace(self.spec, reads_together=False)
        self.asked: list[Array] = []
        self.asks = threading.Event()
        self._may = threading.Semaphore(0)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        self.asked.append(masks[0])
        self.asks.set()
        assert self._may.acquire(timeout=20)
        return super().read(encoded, masks)

    def answer(self, times: int = 1) -> None:
        self._may.release(times)


class Watched:
    """A running session, and its frames."""

    def __init__(self, policy: Slow) -> None:
        self.policy = policy
        self.session = Session(make_env, policy, policies, speed=None)
        self.frames: list[Frame | NoFrame] = []
        self.session.subscribe(self.frames.append)
        self.session.start()

    @property
    def frame(self) -> Frame:
        frame = self.frames[-1]
        assert isinstance(frame, Frame)
        return frame

    def until_asked_at(self, step: int) -> None:
        """Until the policy is asked for its decision at ``step``, and somebody attends."""
        await_that(lambda: len(self.policy.asked) == step + 1)


@contextmanager
def waiting() -> Iterator[Watched]:
    """The policy has been asked at step 1, and does not answer."""
    watched = Watched(Slow())
    try:
        watched.policy.answer()
        watched.until_asked_at(1)
        yield watched
    finally:
        watched.session._closing.set()
        watched.policy.answer(100)
        watched.session.close()


def test_a_switch_is_seen_at_once_and_counts_at_the_next_decision() -> None:
    with waiting() as watched:
        watched.session.send(SetCamera("third_a", OFF))
        await_that(lambda: watched.frame.condition.subset == "first+third_b", REACTS)
        assert watched.frame.pace.waited > 0 and watched.frame.world.step == 0
        assert watched.frame.world.probe.waiting[watched.frame.row]
        watched.session.send(Pause())
        await_that(lambda: watched.frame.pace.phase == "paused", REACTS)
        watched.policy.answer()  # For all cameras, which was asked before the switch.
        await_that(lambda: len(watched.policy.asked) == 3)
        assert watched.policy.asked[-1].tolist() == [True, False, True]
        watched.policy.answer()
        await_that(lambda: watched.frame.world.step == 1 and not watched.frame.pace.waited)
        await_that(lambda: not watched.frame.world.probe.waiting[watched.frame.row])
        shown = watched.frame
        assert (shown.condition.subset, shown.pace.phase) == ("first+third_b", "paused")
        episode = watched.session.save().episodes[-1]
        assert [(one.step, one.command) for one in episode.commands] == [
            (1, SetCamera("third_a", OFF))
        ]


def test_no_frame_takes_a_promise_back() -> None:
    with waiting() as watched:
        watched.session.send(SetCamera("third_a", OFF))
        watched.session.send(Pause())
        await_that(lambda: watched.frame.pace.phase == "paused", REACTS)
        since = len(watched.frames)
        watched.policy.answer(2)
        await_that(lambda: watched.frame.world.step == 1 and len(watched.policy.asked) == 3)
        await_that(lambda: not watched.frame.world.probe.waiting[watched.frame.row])
        for frame in watched.frames[since:]:
            assert isinstance(frame, Frame)
            assert (frame.condition.subset, frame.pace.phase) == ("first+third_b", "paused")


def test_of_many_states_of_a_camera_the_policy_is_asked_for_the_last() -> None:
    with waiting() as watched:
        for state in (OFF, RGB, OFF, RGB, OFF):
            watched.session.send(SetCamera("third_a", state))
        watched.session.send(Pause())
        await_that(lambda: watched.frame.pace.phase == "paused", REACTS)
        watched.policy.answer(2)
        await_that(lambda: watched.frame.world.step == 1 and not watched.frame.pace.waited)
        await_that(lambda: not watched.frame.world.probe.waiting[watched.frame.row])
        assert len(watched.policy.asked) == 3


def test_the_wait_is_counted_in_seconds() -> None:
    with waiting() as watched:
        await_that(lambda: watched.frame.pace.waited >= 2)
        numbers = [frame.pace.number for frame in watched.frames if isinstance(frame, Frame)]
        assert numbers == sorted(set(numbers)) and len(numbers) <= 4


def test_the_first_answer_is_waited_for_in_words() -> None:
    watched = Watched(Slow())
    try:
        await_that(lambda: watched.frames)
        first = watched.frames[0]
        assert isinstance(first, NoFrame) and first.passing
        assert first.title == "Waiting for the policy's first answer: 1 s."
    finally:
        watched.session._closing.set()
        watched.policy.answer(100)
        watched.session.close()


def test_a_session_is_saved_while_its_policy_decides() -> None:
    with waiting() as watched:
        assert watched.session.save().episodes[-1].policy.name == "toy-slow"


def test_nobody_attends_to_a_quick_policy() -> None:
    session = Session(make_env, FakePolicy(), policies)
    frames: list[object] = []
    session.subscribe(frames.append)
    session.tick(0.0)
    session.send(Pause())
    session.attend()
    assert len(frames) == 1


def test_what_is_promised_is_what_comes() -> None:
    for command in (SetCamera("first", OFF), Pause(), SetSpeed(5.0)):
        expected = frame_with(command)
        found = promised(frame_with(), [command])
        assert found.world.ablation == expected.world.ablation
        assert (found.pace.phase, found.pace.speed) == (expected.pace.phase, expected.pace.speed)
    still = frame_with()
    for command in (SetCamera("nowhere", OFF), SetSeed(7), StepOnce()):
        assert promised(still, [command]) == still
    assert promised(still, [Pause(), Play()]).pace.phase == "playing"


def test_a_wait_is_timed_from_its_beginning_and_ends() -> None:
    now = [5.0]
    wait = PolicyWait(lambda: now[0])
    with wait.lasting() as waited:
        assert waited == 0.0
    with wait:
        now[0] = 7.5
        with wait.lasting() as waited:
            assert waited == pytest.approx(2.5)
    with wait.lasting() as waited:
        assert waited == 0.0
