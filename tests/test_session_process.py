"""Sessions in processes of their own: the same frames as here, and what happens when one dies."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import Pipe

import numpy as np
import pytest

from madviz.analysis.foresight import Foresight
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.observation.ablation import Ablation
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.observation.schedule import Event
from madviz.session.commands import (
    Compare,
    Link,
    Pause,
    Play,
    ReadSubsets,
    Reset,
    Scrub,
    SetAutoNext,
    SetCamera,
    SetPolicy,
    SetSaliency,
    SetSchedule,
    SetSeed,
    SetSpeed,
    StepOnce,
)
from madviz.session.frame import Frame, NoFrame
from madviz.session.process import MakeSession, References, SessionProcess
from madviz.session.session import Session
from madviz.session.transfer import FrameDecoder, FrameEncoder
from madviz.types import Array, Encoded, Future
from tests.fakes import FakePolicy, policies
from tests.sessions import OFF, Recorder


def deadly(name: str) -> FakePolicy:
    """A ``load_policy`` of which one ends the process."""
    if name == "deadly":
        os.kill(os.getpid(), signal.SIGSEGV)
    return policies(name)


@dataclass(frozen=True)
class MakeDeadly:
    """A session whose first policy ends its process when it is loaded."""

    def __call__(self, policy: str | None = None) -> Session:
        return Session(make_env, policy or "deadly", deadly)


class Fatal(FakePolicy):
    """Ends its process after twenty looks, as native code may."""

    looks = 0

    def encode(self, views: Array, state: Array) -> Encoded:
        self.looks += 1
        if self.looks > 20:
            os._exit(3)
        return super().encode(views, state)


def fatal(name: str) -> FakePolicy:
    """``policies``, and that one."""
    return Fatal(name) if name == "fatal" else policies(name)


@dataclass(frozen=True)
class MakeFatal:
    """A session with a policy to compare that ends its process after a while."""

    def __call__(self, policy: str | None = None) -> Session:
        return Session(make_env, policy or "toy-mad", fatal)


def filed(name: str) -> FakePolicy:
    """A ``load_policy`` of a folder whose policy has another name than the folder."""
    return FakePolicy("toy-other", seed=3) if name == "runs/mine" else policies(name)


@dataclass(frozen=True)
class MakeFiled:
    """A session that finds policies in a folder, too."""

    def __call__(self, policy: str | None = None) -> Session:
        return Session(make_env, policy or "toy-mad", filed)


@dataclass(frozen=True)
class Make:
    """A session of the toy, paused."""

    ends: bool = False
    """Whether its process ends by itself, as native code may make it, at every start."""

    def __call__(self, policy: str | None = None) -> Session:
        if self.ends:
            os.kill(os.getpid(), signal.SIGSEGV)
        session = Session(make_env, policy or FakePolicy(), policies, seed=3)
        session.send(Pause())
        return session


class Watched:
    """A process's session, and what comes from it."""

    def __init__(self, make: MakeSession = Make()) -> None:
        self.references = References()
        self.news: list[Frame | NoFrame] = []
        self._came = threading.Condition()
        self.session = SessionProcess(make, self.references)
        self.session.subscribe(self._take)
        self.session.start()

    def _take(self, news: Frame | NoFrame) -> None:
        with self._came:
            self.news.append(news)
            self._came.notify_all()

    def until(self, holds: Callable[[Frame | NoFrame], bool], after: int = 0) -> Frame | NoFrame:
        """The first news after the first ``after`` of which ``holds`` is true."""
        with self._came:
            found = self._came.wait_for(lambda: [n for n in self.news[after:] if holds(n)], 60)
            return found[0]

    def step(self, number: int) -> Frame:
        found = self.until(lambda news: isinstance(news, Frame) and news.world.step == number)
        assert isinstance(found, Frame)
        return found

    def kill(self) -> int:
        """Ends the process as a crash would. Returns how much news there was before."""
        process = self.session._process
        assert process is not None and process.pid is not None
        before = len(self.news)
        os.kill(process.pid, signal.SIGSEGV)
        return before


@contextmanager
def watched(make: MakeSession = Make()) -> Iterator[Watched]:
    one = Watched(make)
    try:
        yield one
    finally:
        one.session.close()


def passed_on(frames: list[Frame]) -> list[Frame]:
    """``frames`` at the other end."""
    encoder, decoder = FrameEncoder(), FrameDecoder()
    return [decoder.decode(encoder.encode(frame)) for frame in frames]  # type: ignore[misc]


def frames_of(*commands) -> list[Frame]:
    session = Recorder()
    session.steps(6)
    for command in commands:
        session.ask(command)
    session.steps(3)
    return session.frames


def test_a_frame_arrives_as_it_was():
    frames = frames_of(SetCamera("third_a", OFF))
    for sent, came in zip(frames, passed_on(frames), strict=True):
        assert came.condition == sent.condition and came.pace.number == sent.pace.number
        np.testing.assert_array_equal(came.action, sent.action)
        for stream, picture in sent.world.arrived.items():
            np.testing.assert_array_equal(came.world.arrived[stream], picture)
        assert came.history == sent.history and came.world.outcomes == sent.world.outcomes


def test_what_is_the_same_object_here_is_the_same_object_there():
    commands = (SetCamera("third_a", OFF), Compare("other"), Scrub(0), Play())
    sent = frames_of(*commands)
    came = passed_on(sent)
    parts: list[Callable[[Frame], object]] = [
        lambda frame: frame.world.bodies,
        lambda frame: frame.world.env,
        lambda frame: frame.world.policy,
        lambda frame: frame.world.change,
        lambda frame: frame.history[0],
    ]
    for part in parts:
        same = [part(a) is part(b) for a, b in zip(sent, sent[1:], strict=False)]
        assert [part(a) is part(b) for a, b in zip(came, came[1:], strict=False)] == same
        assert any(same)


def test_what_was_imagined_is_the_same_object_while_nothing_happens():
    frame = frames_of()[-1]
    empty = np.zeros((0, 3, 8, 8, 3), np.uint8)
    seen = Foresight(0, "all", ("first",), Future(empty, np.zeros(0), np.zeros((0, 2))))
    first, second = passed_on([replace(frame, foresight=seen)] * 2)
    assert first.foresight is not None and first.foresight is second.foresight


def test_both_ends_forget_what_is_not_used_any_more():
    encoder, decoder = FrameEncoder(), FrameDecoder()
    session = Recorder()
    sizes = []
    for episode in range(4):
        session.ask(SetSeed(episode))
        for _ in range(5):
            frame = session.steps(1)
            decoder.decode(encoder.encode(frame))
        sizes.append((len(encoder._known), len(decoder._known)))
    assert all(here == there for here, there in sizes)
    assert sizes[1] == sizes[3]


def test_scenes_and_the_past_are_sent_once():
    encoder = FrameEncoder()
    session = Recorder()
    lengths = [len(encoder.encode(session.steps(1))) for _ in range(20)]
    pictures = sum(picture.nbytes for picture in session.frames[-1].world.arrived.values())
    views = session.frames[-1].world.views.values()
    raw = sum(view.rgb.nbytes + view.depth.nbytes for view in views)
    assert lengths[0] > lengths[1]
    assert max(lengths[1:]) < pictures + raw + 20_000


def test_a_session_in_a_process_obeys_and_saves_as_one_here():
    here = Recorder(seed=3)
    here.ask(Pause())
    for command in (StepOnce(), SetCamera("third_a", OFF), StepOnce()):
        last = here.ask(command)
    with watched() as one:
        one.session.send(StepOnce())
        one.step(1)
        one.session.send(SetCamera("third_a", OFF))
        one.session.send(StepOnce())
        there = one.step(2)
        np.testing.assert_array_equal(there.action, last.action)
        assert one.session.save().episodes[-1].steps == here.save().episodes[-1].steps == 2
        assert one.session.save().episodes[-1].trace == here.save().episodes[-1].trace
        process = one.session._process
    assert process is not None and not process.is_alive()


def test_a_policy_keeps_the_name_by_which_it_was_loaded():
    def mine(news: Frame | NoFrame) -> bool:
        return isinstance(news, Frame) and news.world.policy.name == "toy-other"

    with watched(MakeFiled()) as one:
        one.session.send(SetPolicy("runs/mine"))
        for after in (0, one.kill):  # Another process loads it by that name, too.
            found = one.until(mine, after() if callable(after) else after)
            assert isinstance(found, Frame) and found.world.reference == "runs/mine"
            assert one.references.name_of(found.world.policy) == "runs/mine"


def test_a_process_that_dies_is_started_again_with_the_same_seed_and_cameras():
    with watched() as one:
        one.session.send(SetCamera("third_a", OFF))
        one.session.send(SetSeed(7))
        one.session.send(Pause())
        one.until(lambda n: isinstance(n, Frame) and n.world.seed == 7)
        before = one.kill()
        told = one.until(lambda n: isinstance(n, NoFrame), before)
        assert isinstance(told, NoFrame) and "(SIGSEGV). It starts again" in told.title
        again = one.until(
            lambda n: isinstance(n, Frame) and n.world.seed == 7 and bool(n.world.ablation.cameras),
            before,
        )
        assert isinstance(again, Frame) and again.camera("third_a") == OFF
        one.until(lambda n: isinstance(n, Frame) and n.pace.phase == "paused", before)
        shown = [n for n in one.news[before:] if isinstance(n, Frame)]
        assert {n.world.seed for n in shown} == {7}, "or a second end would lose the seed"
        assert all(n.camera("third_a") == OFF for n in shown)
        one.session.send(StepOnce())
        one.step(1)


def test_a_process_that_is_started_again_knows_all_that_was_shown():
    """Failures, B, the link and the switches; of the cameras, what a failure did is not kept."""
    fails = (Event(2, "first", dropped=True),)
    aside = {"third_b": Displacement(right=0.1)}
    with watched() as one:
        for command in (
            SetSpeed(50.0),
            SetAutoNext(False),
            ReadSubsets(True),
            SetSaliency("action"),
            MoveCamera("third_b", aside["third_b"]),
            Compare("toy-other", Ablation({"third_a": OFF})),
            Link(False),
            SetSchedule(fails),
            Play(),
        ):
            one.session.send(command)
        one.until(lambda n: isinstance(n, Frame) and n.pace.phase == "ended")
        before = one.kill()
        again = one.until(lambda n: isinstance(n, Frame), before)
        assert isinstance(again, Frame) and again.second is not None
        pace, second = again.pace, again.second.world
        assert (pace.phase, pace.speed, pace.auto_next, pace.reads_all) == (
            "playing",
            50.0,
            False,
            True,
        )
        assert (again.explained, again.schedule, again.linked) == ("action", fails, False)
        assert again.world.step < 2 and again.mask.all() and again.world.ablation.moves == aside
        assert second.policy.name == "toy-other" and second.ablation.camera("third_a") == OFF


def test_another_policy_helps_where_the_first_one_ends_every_process():
    with watched(MakeDeadly()) as one:
        one.until(lambda n: isinstance(n, NoFrame) and "third time" in n.title)
        one.session.send(SetPolicy("toy-other"))
        found = one.until(lambda n: isinstance(n, Frame))
        assert isinstance(found, Frame) and found.world.policy.name == "toy-other"


def test_a_comparison_that_ends_every_process_is_left_out():
    with watched(MakeFatal()) as one:
        one.until(lambda n: isinstance(n, Frame))
        for command in (SetSpeed(50.0), Compare("fatal"), Play()):
            one.session.send(command)
        one.until(lambda n: isinstance(n, Frame) and n.second is not None)
        one.until(lambda n: isinstance(n, NoFrame) and "third time" in n.title)
        before = len(one.news)
        one.session.send(Play())
        found = one.until(lambda n: isinstance(n, Frame) and n.world.step > 4, before)
        assert isinstance(found, Frame) and found.second is None


def test_the_third_end_within_a_minute_waits_for_the_visitor():
    with watched(Make(ends=True)) as one:
        told = one.until(lambda n: isinstance(n, NoFrame) and "third time" in n.title)
        count = len(one.news)
        time.sleep(0.5)
        assert len(one.news) == count == 3
        assert isinstance(told, NoFrame) and "press Play" in told.title
        one.session.send(Play())
        one.until(lambda n: isinstance(n, NoFrame), count)


def test_nothing_to_save_is_an_error_here_too():
    with watched() as one:
        one.step(0)
        with pytest.raises(UserError):
            one.session.save()
        one.session.send(Reset())


def test_a_session_that_was_never_started_can_be_closed():
    SessionProcess(Make()).close()


def test_a_second_end_before_the_first_frame_still_knows_seed_and_cameras():
    session = SessionProcess(Make())
    here = Recorder(seed=41)
    here.ask(SetCamera("third_a", OFF), Pause())
    ours, theirs = Pipe()
    theirs.send(("frame", FrameEncoder().encode(here.frames[-1])))
    theirs.close()
    session._read(ours)
    for end in ("first", "second"):
        session._publish(NoFrame("", f"the {end} end"))
        began = session._beginning()[1]
        assert all(one in began for one in (SetCamera("third_a", OFF), SetSeed(41), Pause()))
        ours, theirs = Pipe()
        theirs.close()
        session._read(ours)  # Nothing came.


@pytest.mark.parametrize("name", ["nonsense", "toy-other"])
def test_a_choice_that_was_shown_or_failed_is_no_choice_any_more(name: str):
    session = SessionProcess(Make())
    here = Recorder()
    here.at(0.0)
    session.send(SetPolicy(name))
    assert session._beginning()[0] == name
    session._note(here.ask(SetPolicy(name)))
    session._note(here.ask(SetPolicy("toy-mad"), Play()))
    assert session._beginning()[0] == "toy-mad"
