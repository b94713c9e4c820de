"""One visitor's session: commands in, frozen frames out, at a steady pace.

The problem: a page has many threads, a simulator and its OpenGL context have one. And a decision
costs 15 to 20 ms, most of it drawing three cameras, while a visitor who switches a camera off wants
to see the effect at once.

The idea: one thread owns everything and runs ``tick(now)``; everybody else calls ``send``. Commands
that touch a camera are served between the camera renders of a step, too:

    tick ── serve ── act ── step ── draw A ── serve ── draw B ── serve ── draw C ── encode ── emit
                                                └─ re-read, emit             (about 5 ms each)
"""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import takewhile
from typing import Self

from madviz.errors import CannotAct, UserError
from madviz.observation.displacement import MoveCamera
from madviz.policies.seeds import FIRST_LIVE
from madviz.session.commands import (
    IN_ANY_ORDER,
    Command,
    Compare,
    Foresee,
    Fork,
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
from madviz.session.comparison import EnvFactory
from madviz.session.frame import Frame, NoFrame, Phase, SessionPace
from madviz.session.inbox import Inbox
from madviz.session.live_session import MOST_WAITING, TOO_MANY, LiveSession
from madviz.session.pace import HOLD_TO_READ, StepClock
from madviz.session.session_file import SavedEpisode, SavedSession
from madviz.session.stage import Stage
from madviz.session.waiting import ATTENDED_AFTER, LOOKS_EVERY, promised
from madviz.system.priority import lower_thread_priority
from madviz.types import Policy

FIRST_SEED = FIRST_LIVE
"""Seeds of live episodes begin here."""
NICENESS = 10
"""The niceness of the simulating thread, on a scale where 19 yields to all others; workers are at
15."""
FIRST_ANSWER = "Waiting for the policy's first answer: {} s."


class Session(LiveSession):
    """See the module. What is not of ``LiveSession`` belongs to the thread that ticks."""

    def __init__(
        self,
        make_env: EnvFactory,
        policy: Policy | str,
        load_policy: Callable[[str], Policy] | None = None,
        *,
        seed: int = FIRST_SEED,
        speed: float | None = 10.0,
        script: SavedEpisode | None = None,
    ) -> None:
        """``policy``: one that is there, or the name of one that the session's thread shall load.
        ``script``: an episode to replay, once played; it begins with ``policy``."""
        super().__init__()
        self._stage = Stage(make_env, policy, load_policy, seed, script)
        self.inbox = Inbox()
        """Another one must be put here before the session runs."""
        self._backlog: deque[Command] = deque()
        self._current: Command | None = None
        """The one that is being carried out."""
        self._attended = False
        """Whether commands of the backlog were shown already, as they will be."""
        self._told = 0
        """Whole seconds of waiting for the policy that were shown last."""
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._pace = StepClock(speed)
        self._auto_next = True
        self._read_all = False
        self._pass_takes = 0.0
        self._paused = script is not None
        self._number = 0
        self._error = ""
        self._was_paused: bool | None = None
        """Before the error, where it says that a policy lacks a camera."""

    def send(self, command: Command) -> None:
        if len(self.inbox) + len(self._backlog) >= MOST_WAITING:
            raise UserError(TOO_MANY)
        self.inbox.put(command)

    def save(self, present_only: bool = False) -> SavedSession:
        return self._stage.journal.saved(present_only)

    def start(self) -> Self:
        """Runs ``run`` in a thread of its own."""
        self._thread = threading.Thread(target=self.run, name="madviz-session", daemon=True)
        self._thread.start()
        return self

    def close(self, timeout: float = 10.0) -> None:
        """Ends the thread, which closes the environment."""
        self._closing.set()
        self.inbox.put(None)
        if self._thread is not None:
            self._thread.join(timeout)

    def run(self) -> None:
        """Ticks when a step is due or a command arrives, until ``close``. At full speed it would
        take a core for itself, so those who carry its frames to the visitor go first."""
        attendant = threading.Thread(target=self._attend, name="madviz-attends", daemon=True)
        attendant.start()
        lower_thread_priority(NICENESS)
        try:
            while not self._closing.is_set():
                due = self.tick(time.monotonic())
                if self._closing.is_set():
                    break  # What would end the wait below may have come during the tick.
                wait = None if due is None else max(0.0, due - time.monotonic())
                if (command := self.inbox.take(wait)) is not None:
                    self._backlog.append(command)
        finally:
            self._closing.set()
            attendant.join()
            self._stage.shut()

    def tick(self, now: float) -> float | None:
        """Carries out what has come, and takes a step or starts an episode if one is due. Returns
        when to call again; None if nothing happens before the next command."""
        if not self._stage.is_open and not self._error:
            self._guarded(lambda: self._begin(self._stage.seed, now))
        self._collect()
        while self._backlog and not self._closing.is_set():
            self._current = command = self._backlog.popleft()
            self._guarded(lambda command=command: self._carry_out(command, now))
            self._current = None
        self._attended = False
        if self._moving() and now >= self._pace.due and not self._closing.is_set():
            self._guarded(lambda: self._advance(now))
        self._guarded(lambda: self._explain(now))
        replays = self._stage.ended and self._pace.speed is not None and not self._error
        if replays:
            self._guarded(lambda: self._retrace(now))
        waiting = self._backlog or (replays and self._stage.retracing)
        if waiting or (self._read_all and self._read_more(now)):
            return now
        return self._pace.due if self._moving() else None

    def _attend(self) -> None:
        """The thread that answers a visitor while the policy decides."""
        while not self._closing.wait(LOOKS_EVERY):
            self.attend()

    def attend(self) -> None:
        """If the policy has been asked for a while: takes what has come, and shows what it will do.
        From any thread."""
        with self._stage.wait.lasting() as waited:
            if waited < ATTENDED_AFTER:
                self._told = 0
                return
            before = len(self._backlog)
            self._collect()
            if len(self._backlog) == before and int(waited) == self._told:
                return
            self._told = int(waited)
            self._number += 1
            if isinstance(self.latest, Frame):
                self._attended = True
                waiting = [self._current, *self._backlog] if self._current else self._backlog
                frame = promised(self.latest, waiting)
                pace = replace(frame.pace, number=self._number, waited=waited)
                self._publish(replace(frame, pace=pace))
            else:
                self._publish(NoFrame("", FIRST_ANSWER.format(self._told), passing=True))

    def _read_more(self, now: float) -> bool:
        """One subset more, if the next step leaves time for it; whether one was read."""
        if self._error or (self._moving() and now + self._pass_takes >= self._pace.due):
            return False
        began = time.monotonic()
        before = self._number
        self._guarded(lambda: self._stage.read_more() and self._emit())
        self._pass_takes = time.monotonic() - began
        return self._number > before and not self._error

    def _retrace(self, now: float) -> None:
        """One decision of the ended episode's replay with all cameras; its end is to be read."""
        if self._stage.retrace():
            self._pace.due = max(self._pace.due, now + HOLD_TO_READ)
            self._emit()

    def _explain(self, now: float) -> None:
        """After everything else, because it takes as long as a step."""
        if self._stage.explain(now, self._phase == "playing", self._pace.speed is None):
            self._emit()

    @property
    def _phase(self) -> Phase:
        """Found anew each time, so that whatever begins an episode ends the end of the last one."""
        return "paused" if self._paused else "ended" if self._stage.ended else "playing"

    def _moving(self) -> bool:
        waiting = self._phase == "ended" and self._auto_next
        return self._stage.is_open and (self._phase == "playing" or waiting)

    def _guarded(self, work: Callable[[], object]) -> None:
        """An error pauses the session and shows on the page; the session goes on. The one place
        that catches everything: whatever a policy or a simulator throws, a visitor must see it."""
        try:
            work()
        except Exception as error:
            first = f"{error}\n\n" if isinstance(error, UserError) else ""
            if not first:  # Nobody knows how far it came.
                self._stage.journal.spoil()
            self._error = first + traceback.format_exc()
            self._was_paused = self._paused if isinstance(error, CannotAct) else None
            self._paused = True
            try:
                self._emit(keep=False)
            except Exception:  # Not even a picture of it can be had, but the words can.
                self._publish(NoFrame(self._error))

    # What happens.

    def _begin(self, seed: int, now: float) -> None:
        self._stage.begin(seed, self._serve_cameras)
        self._began(now)

    def _began(self, now: float) -> None:
        self._error = ""
        self._pace.begin(now)
        self._emit()

    def _advance(self, now: float) -> None:
        """The next step, or the episode that is due."""
        due = self._stage.due
        if due is not None:
            self._begin(due, now)
            return
        self._stage.step(self._serve_cameras)
        self._pace.step(now)
        if self._stage.ended:
            self._pace.hold(now, self._stage.has_an_ending)
        self._emit()

    # Commands.

    def _collect(self) -> None:
        """Moves what came to the backlog, in order, as far as there is room."""
        while len(self._backlog) < MOST_WAITING and (command := self.inbox.take()) is not None:
            self._backlog.append(command)

    def _serve_cameras(self) -> None:
        """In the middle of a step: previews camera commands, leaves the others, and what must stay
        behind them, for later."""
        self._collect()
        for command in [one for one in self._ahead() if isinstance(one, SetCamera)]:
            self._backlog.remove(command)
            self._guarded(lambda command=command: self._touch(command, preview=True))

    def _ahead(self) -> Iterator[Command]:
        """The backlog up to the first command that must not be overtaken."""
        return takewhile(lambda one: isinstance(one, IN_ANY_ORDER), self._backlog)

    def _touch(self, command: SetCamera | MoveCamera, preview: bool = False) -> None:
        """Only the last of several states or moves of one camera: each may be a question to the
        policy or a picture to draw, and a slider that is dragged sends more of them than some
        simulators can draw."""
        later = (one for one in self._ahead() if isinstance(one, type(command)))
        last = all(one.camera != command.camera for one in later)
        if self._stage.is_open and last:
            self._stage.touch(command, preview)
            if self._error and self._was_paused is not None and self._stage.can_act:
                self._error = ""
                self._paused = self._was_paused  # It goes on as before.
            self._emit(keep=not preview)

    def _carry_out(self, command: Command, now: float) -> None:
        match command:
            case SetCamera() | MoveCamera():
                self._touch(command)
                return
            case SetPolicy(name):
                self._swap(name, now)
                return
            case SetSeed(seed):
                self._restart(seed, now)
                return
            case Reset(next_seed):
                self._restart(self._stage.seed + next_seed, now)
                return
            case Compare(name, ablation):
                self._stage.compare(name, ablation)
                self._began(now)
                return
            case Play():
                self._play(now)
            case Pause():
                self._halt()
            case StepOnce():
                self._step_once(now)
            case SetSpeed(rate):
                self._pace.speed = rate
                self._pace.due = now if self._phase == "playing" else self._pace.due
                self._pace.forget()
            case SetAutoNext(on):
                self._auto_next = on
            case SetSaliency(target):
                self._stage.saliency.ask(target, lambda: self.inbox.put(None))
            case Foresee(on):
                self._stage.foresee(on)
            case ReadSubsets(on):
                self._read_all = on
            case SetSchedule(events):
                self._stage.reschedule(events)
            case Scrub(step):
                self._stage.show_step(step)
                self._halt()
            case Fork():
                self._stage.fork()
                self._play(now)
                self._pace.due = now + self._pace.period
            case Link(on):
                self._stage.link(on)
        self._emit()

    def _restart(self, seed: int, now: float) -> None:
        if self._error or not self._stage.is_open or self._stage.ended:
            self._paused = False
        self._begin(seed, now)

    def _play(self, now: float) -> None:
        self._stage.show_step(None)
        if self._stage.due is not None:
            self._advance(now)
        else:
            self._pace.due = now
        self._paused = False
        self._error = ""
        self._pace.forget()

    def _halt(self) -> None:
        self._paused = True
        self._pace.forget()

    def _step_once(self, now: float) -> None:
        self._error = ""
        self._stage.show_step(None)
        self._advance(now)
        self._halt()

    def _swap(self, name: str, now: float) -> None:
        """Another policy. After an error it may be the one that can go on."""
        if self._stage.swap(name):
            self._began(now)
            return
        self._error = ""
        self._pace.interrupt()
        self._emit()

    # Frames.

    def _emit(self, keep: bool = True) -> None:
        self._number += 1
        pace = SessionPace(
            number=self._number,
            phase=self._phase,
            speed=self._pace.speed,
            rate=self._pace.rate,
            auto_next=self._auto_next,
            reads_all=self._read_all,
            error=self._error,
        )
        frame = self._stage.frame(keep, pace)
        if frame is not None and self._attended:
            frame = promised(frame, self._backlog)
        self._publish(frame or NoFrame(self._error))
