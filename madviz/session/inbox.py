"""Commands on their way to a session's thread, with as few threads between as can be.

The problem: a click that goes from thread to thread waits for each of them to get a core and
Python's interpreter lock. On two cores, with a browser and a simulator at full speed on them, most
of these waits take 0.1 ms, but one in twenty takes 70 to 400 ms. They were half of the slowest
switches of ``benchmarks live``.

The idea: whoever hears the visitor writes to the pipe, and the simulating thread reads it.

    before   hears ── queue ── writer ── pipe ── reader ── queue ── simulates
    now      hears ───────────────────── pipe ─────────────────────── simulates

Only what a process has no time for, as while it loads a policy, waits in a queue with a writer.
"""

from __future__ import annotations

import queue
import select
import threading
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any

from madviz.session.commands import Command


class Inbox:
    """The commands that a session has been sent, from any thread of its process."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[Command | None] = queue.SimpleQueue()

    def __len__(self) -> int:
        return self._queue.qsize()

    def put(self, command: Command | None) -> None:
        """Queues a command; None only wakes who waits."""
        self._queue.put(command)

    def take(self, timeout: float | None = 0.0) -> Command | None:
        """The next command. Waits up to ``timeout`` seconds for it; None: for ever. A None that a
        command waits behind is passed over."""
        try:
            command = self._queue.get(block=timeout != 0.0, timeout=timeout)
            while command is None and len(self):
                command = self._queue.get_nowait()
            return command
        except queue.Empty:
            return None


class PipeInbox(Inbox):
    """And through a pipe, from another process."""

    def __init__(self, before: Inbox, pipe: Connection, other: Callable[[Any], None]) -> None:
        """Instead of ``before``, whose commands it takes over. ``other`` gets what comes through
        ``pipe`` and is no command, and None at its end, in the thread that takes."""
        super().__init__()
        self._pipe = pipe
        self._other = other
        self._wakes, self._waker = Pipe(duplex=False)
        while (command := before.take()) is not None:
            self.put(command)

    def put(self, command: Command | None) -> None:
        super().put(command)
        self._waker.send_bytes(b"")

    def take(self, timeout: float | None = 0.0) -> Command | None:
        """As ``Inbox.take``; it may return None although there is more, or before the time."""
        ready = wait([self._pipe, self._wakes], timeout)
        if self._wakes in ready:
            self._wakes.recv_bytes()
            return super().take()
        if self._pipe in ready:
            try:
                what = self._pipe.recv()
            except (EOFError, OSError):
                what = None
            if isinstance(what, Command):
                return what
            self._other(what)
        return None


class Outbox:
    """The other end of a ``PipeInbox``; from any thread, and never waits for the process."""

    def __init__(self) -> None:
        self._waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._behind = 0
        """How much waits for the writer, or is being written by it."""
        self._pipe: Connection | None = None
        self._writing = threading.Lock()

    def __len__(self) -> int:
        return self._behind

    def put(self, what: Any) -> None:
        """Sends ``what``, or leaves it to the writer; None is the last."""
        with self._writing:
            pipe = None if self._behind or what is None else self._pipe
            if pipe is not None and _has_room(pipe):
                _send(pipe, what)
            else:
                self._behind += 1
                self._waiting.put(what)

    def write(self, pipe: Connection) -> None:
        """The writer, in a thread of its own: opens the pipe, ends with None. What comes for a
        process that has ended is left out."""
        self._pipe = pipe
        what: Any = self
        while what is not None:
            what = self._waiting.get()
            _send(pipe, what)
            with self._writing:
                self._behind -= 1


def _has_room(pipe: Connection) -> bool:
    """Whether a command goes in without waiting: a socket takes more as long as half of its 200 kB
    are free, and no command is longer than a page's longest message, 64 kB."""
    poll = select.poll()
    poll.register(pipe.fileno(), select.POLLOUT)
    return any(event & select.POLLOUT for _, event in poll.poll(0))


def _send(pipe: Connection, what: Any) -> None:
    try:
        pipe.send(what)
    except OSError:  # Nobody is there any more.
        pass
