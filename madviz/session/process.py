"""A session in a process of its own: the same commands in, the same frames out.

The problem: threads of one process take turns at Python's interpreter lock. Eight visitors whose
simulations are threads of the page's process get half of the decisions that they ask for, it never
uses more than 1.4 cores, and a crash in native code (a renderer, a simulator) ends it for all.

The idea: a session knows nothing of pages, so it can live elsewhere. Commands and frames go through
a pipe.

    page's process                  simulation's process
    send(command) ─────── pipe ───► Session, in the only thread (``inbox.py``)
    listeners ◄─ reader ◄ pipe ◄─── Session

A page that is slow to read holds the simulation up, as it did when they shared a process; what it
does not show in time it leaves out. A frame of hammer is 0.29 MB: 0.46 ms to write, 0.09 ms on the
way and 0.18 ms to read, after a step of 16 ms. So it goes through the pipe, and no memory is shared
that could be left behind.

Processes are forked from a *fork server* (``fork_server.py``), which has imported torch and done
nothing else, so a simulation starts in a moment and shares that memory. A process that ends by
itself is started again with all that the last frame shows, on the same seed, and the page says so.
What no frame shows may be what ended it. The third time within a minute it stays as it is until the
visitor does something.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Self

from madviz.errors import UserError
from madviz.observation.displacement import MoveCamera
from madviz.session.commands import (
    Command,
    Compare,
    Link,
    Pause,
    Play,
    ReadSubsets,
    SetAutoNext,
    SetCamera,
    SetPolicy,
    SetSaliency,
    SetSchedule,
    SetSeed,
    SetSpeed,
)
from madviz.session.frame import Frame, NoFrame
from madviz.session.inbox import Outbox, PipeInbox
from madviz.session.live_session import MOST_WAITING, TOO_MANY, LiveSession
from madviz.session.session import Session
from madviz.session.session_file import SavedSession
from madviz.session.transfer import FrameDecoder, FrameEncoder
from madviz.system.processes import limit_heaps, release_memory, set_up_worker
from madviz.types import PolicySpec

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerProcess

log = logging.getLogger(__name__)

MakeSession = Callable[[str | None], Session]
"""Makes a session that is not started yet, in the process where it shall live; it begins with the
policy of that name, if there is one, instead of its own. Picklable."""
MOST_ENDS = 3
"""Times that a process may end within ``ENDS_WITHIN`` seconds and is started again."""
ENDS_WITHIN = 60.0
SAVING = 10.0
"""Seconds that ``save`` waits."""
_CONTEXT = multiprocessing.get_context("forkserver")


class References:
    """The names by which policies are loaded, of all that any visitor's frames have shown."""

    def __init__(self) -> None:
        self._names: dict[PolicySpec, str] = {}

    def note(self, name: str, spec: PolicySpec) -> None:
        """``load_policy`` knows the policy ``spec`` by ``name``; the first one stays."""
        self._names.setdefault(spec, name)

    def name_of(self, spec: PolicySpec) -> str:
        """The name by which ``load_policy`` finds a policy: its own name unless noted otherwise."""
        return self._names.get(spec, spec.name)


class SessionProcess(LiveSession):
    """See the module. What a ``Session`` offers to a page, and may be called from any thread."""

    def __init__(self, make: MakeSession, references: References | None = None) -> None:
        """``references`` learns the name of every policy that is shown."""
        super().__init__()
        self._make = make
        self._references = references or References()
        self._outbox = Outbox()
        """For the process that is running; a command, or what else it shall do."""
        self._saved: queue.SimpleQueue[SavedSession | str] = queue.SimpleQueue()
        self._saving = threading.Lock()
        self._closing = threading.Event()
        self._wanted = threading.Event()
        self._chosen: str | None = None
        """The policy that the visitor has chosen since the last process ended, until it is shown or
        an error is."""
        self._shown: Frame | None = None
        """The newest step that was shown, of all processes: where the next one goes on."""
        self._process: ForkServerProcess | None = None
        self._thread = threading.Thread(target=self._run, name="madviz-session", daemon=True)

    def send(self, command: Command) -> None:
        """As ``Session.send``. Never waits for the process."""
        if len(self._outbox) >= MOST_WAITING:
            raise UserError(TOO_MANY)
        if isinstance(command, SetPolicy):
            self._chosen = command.name
        self._outbox.put(command)
        self._wanted.set()

    def save(self, present_only: bool = False) -> SavedSession:
        """As ``Session.save``. Raises UserError also where the process gives no answer."""
        with self._saving:
            while not self._saved.empty():  # An answer that came too late for whoever asked.
                self._saved.get()
            self._outbox.put(present_only)
            try:
                answer = self._saved.get(timeout=SAVING)
            except queue.Empty:
                raise UserError(
                    f"expected the saved session within {SAVING:g} s, found no answer from the "
                    "simulation's process; try again"
                ) from None
        if isinstance(answer, str):
            raise UserError(answer)
        return answer

    def start(self) -> Self:
        """Starts the process, and a thread that reads what comes from it."""
        self._thread.start()
        return self

    def close(self, timeout: float = 10.0) -> None:
        """Ends the process, which closes its environment; kills it if that takes longer."""
        self._closing.set()
        self._wanted.set()
        self._outbox.put(None)
        if self._thread.ident is None:
            return
        self._thread.join(timeout)
        process = self._process
        if process is not None and process.is_alive():
            process.kill()
            self._thread.join(timeout)

    # The reading thread.

    def _run(self) -> None:
        ends: deque[float] = deque(maxlen=MOST_ENDS)
        while not self._closing.is_set():
            how = self._one_life()
            if self._closing.is_set():
                return
            ends.append(time.monotonic())
            words = f"The simulation's process ended by itself ({how})."
            log.error("%s", words)
            if len(ends) == MOST_ENDS and ends[-1] - ends[0] < ENDS_WITHIN:
                ends.clear()
                self._wanted.clear()
                again = "Choose another policy, or press Play to start it again."
                if self._shown is not None:  # What can be left out may be what ends it.
                    self._shown = replace(self._shown, second=None, explained=None)
                self._publish(NoFrame("", f"{words} That was the third time in a minute. {again}"))
                self._wanted.wait()
            else:
                self._publish(NoFrame("", f"{words} It starts again with the same seed."))

    def _one_life(self) -> str:
        """Runs a process until it ends. Returns how it ended, in words."""
        here, there = _CONTEXT.Pipe()
        self._process = process = _CONTEXT.Process(
            target=_live,
            args=(there, self._make, *self._beginning()),
            name="madviz-simulation",
            daemon=True,
        )
        process.start()
        there.close()
        writer = threading.Thread(target=self._outbox.write, args=(here,), daemon=True)
        writer.start()
        self._read(here)
        process.join()
        self._begin_anew()
        writer.join()
        here.close()
        return _how(process.exitcode)

    def _begin_anew(self) -> None:
        """Leaves the commands that were meant for the last process: one of them may have ended
        it."""
        self._chosen = None
        before = self._outbox
        self._outbox = Outbox()
        before.put(None)
        if self._closing.is_set():
            self._outbox.put(None)

    def _beginning(self) -> tuple[str | None, tuple[Command, ...]]:
        """The policy and the commands that bring a new process to where the last one was."""
        shown = self._shown
        if shown is None:
            return self._chosen, ()
        return self._chosen or shown.world.reference, tuple(self._as_in(shown))

    def _as_in(self, shown: Frame) -> Iterator[Command]:
        """Commands for all that is as in ``shown``, but the policy and the step."""
        world = shown.world
        pace = shown.pace
        yield from (SetSpeed(pace.speed), SetAutoNext(pace.auto_next))
        yield from (ReadSubsets(pace.reads_all), SetSaliency(shown.explained))
        for name, state in world.ablation.cameras.items():
            yield SetCamera(name, state)
        for name, move in world.ablation.moves.items():
            yield MoveCamera(name, move)
        if shown.second is not None:
            b = shown.second.world
            yield Compare(b.reference, b.ablation)
            yield Link(shown.linked)
        # The seed after the failures, which begin with it: none of them has come at its first step.
        yield from (SetSchedule(shown.schedule), SetSeed(world.seed))
        yield Pause() if pace.phase == "paused" else Play()

    def _note(self, frame: Frame) -> None:
        """An earlier step that is shown again is not where the simulation stands."""
        stands = self._shown if frame.past else None
        self._shown = frame
        for side in filter(None, (frame, frame.second)):
            self._references.note(side.world.reference, side.world.policy)
        if stands is not None:
            self._shown = replace(frame, world=stands.world, second=stands.second)
        if frame.pace.error or self._shown.world.reference == self._chosen:
            self._chosen = None

    def _read(self, pipe: Connection) -> None:
        """Until the process ends."""
        decoder = FrameDecoder()
        while True:
            try:
                kind, what = pipe.recv()
            except (EOFError, OSError):
                return
            if kind == "frame":
                news = decoder.decode(what)
                if isinstance(news, Frame):
                    self._note(news)
                self._publish(news)
            elif kind == "saved":
                self._saved.put(what)


def _how(code: int | None) -> str:
    """``SIGSEGV``, ``exit status 1``."""
    if code is not None and code < 0:
        return signal.Signals(-code).name
    return f"exit status {code}"


# --- In the process ---------------------------------------------------------------------------


def _live(
    pipe: Connection, make: MakeSession, policy: str | None, commands: tuple[Command, ...]
) -> None:
    """Runs a session until the page's process says None, or is gone. Nothing of it is shown before
    ``commands`` have been carried out: if it ends there, the next one still begins with them."""
    set_up_worker()
    limit_heaps()

    def say(kind: str, what: object) -> None:
        with suppress(OSError):  # The page's process is gone, and so is this one in a moment.
            pipe.send((kind, what))

    session = make(policy)
    encoder = FrameEncoder()
    first = iter([True])

    def send(news: Frame | NoFrame) -> None:
        say("frame", encoder.encode(news))
        if next(first, False):
            release_memory()  # What it took to get here: 30 MB of meshes and XML.

    def other(present_only: bool | None) -> None:
        if present_only is None:
            session.close()
            return
        try:
            say("saved", session.save(present_only))
        except UserError as error:
            say("saved", str(error))

    for command in commands:
        session.send(command)
    if commands:
        session.tick(time.monotonic())
    session.subscribe(send)
    session.inbox = PipeInbox(session.inbox, pipe, other)
    session.run()
    os._exit(0)  # Python's own end would wait for threads, and libraries tidy up for a second.
