"""The members of a session that a page needs, wherever the session runs."""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

from madviz.session.commands import Command
from madviz.session.frame import Frame, NoFrame
from madviz.session.session_file import SavedSession

log = logging.getLogger(__name__)

Listener = Callable[[Frame | NoFrame], None]
MOST_WAITING = 1000
"""Commands that wait to be carried out; a camera is touched within 5 ms, so that is 5 s of work."""
TOO_MANY = f"expected at most {MOST_WAITING} commands at once, found more; wait a moment"


class LiveSession(ABC):
    """A session as a page sees it, and those who listen to it. It lives in a thread of the page's
    process (``Session``) or in a process of its own (``SessionProcess``).

    All public methods may be called from any thread, ``_publish`` only from the one that brings the
    frames.
    """

    def __init__(self) -> None:
        self.latest: Frame | NoFrame | None = None
        """The newest frame that came; None before the first."""
        self._listeners: tuple[Listener, ...] = ()
        self._listening = threading.Lock()
        """Guards changes of ``_listeners``."""

    @abstractmethod
    def send(self, command: Command) -> None:
        """Queues a command; the session carries it out within one camera render, a step at most.
        Raises UserError where too many wait already."""

    @abstractmethod
    def save(self, present_only: bool = False) -> SavedSession:
        """The present episode, after the last ones unless ``present_only``, to be replayed. Raises
        UserError if there is no step yet."""

    @abstractmethod
    def start(self) -> Self:
        """Begins; returns itself."""

    @abstractmethod
    def close(self, timeout: float = 10.0) -> None:
        """Ends the simulation, which closes its environment; waits ``timeout`` seconds at most."""

    def subscribe(self, listener: Listener) -> None:
        """``listener`` gets every frame that comes, in the thread that brings it, and the latest
        one at once. It must return quickly: put the frame somewhere and leave."""
        with self._listening:
            self._listeners = (*self._listeners, listener)
        if self.latest is not None:
            listener(self.latest)

    def unsubscribe(self, listener: Listener) -> None:
        """Does nothing for a listener that is none."""
        with self._listening:
            self._listeners = tuple(known for known in self._listeners if known != listener)

    def _publish(self, news: Frame | NoFrame) -> None:
        """To everybody. A listener that fails must not take the session from the others."""
        self.latest = news
        for listener in self._listeners:
            try:
                listener(news)
            except Exception:
                log.exception("somebody who listens to a session failed")
