"""What a page needs of a session, wherever that runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from madviz.session.commands import Command
from madviz.session.frame import Frame, NoFrame
from madviz.session.session_file import SavedSession

Listener = Callable[[Frame | NoFrame], None]
MOST_WAITING = 1000
"""Commands that wait to be carried out; a camera is touched within 5 ms, so that is 5 s of work."""
TOO_MANY = f"expected at most {MOST_WAITING} commands at once, found more; wait a moment"


class LiveSession(Protocol):
    """In a thread of the page's process (``Session``) or in a process of its own
    (``SessionProcess``); all of it may be called from any thread."""

    latest: Frame | NoFrame | None
    """The newest frame that came; None before the first."""

    def send(self, command: Command) -> None:
        """Queues a command; the session carries it out within one camera render, a step at most.
        Raises UserError where too many wait already."""
        ...

    def subscribe(self, listener: Listener) -> None:
        """``listener`` gets every frame that comes, in the thread that brings it, and the latest
        one at once. It must return quickly: put the frame somewhere and leave."""
        ...

    def unsubscribe(self, listener: Listener) -> None:
        """Does nothing for a listener that is none."""
        ...

    def save(self) -> SavedSession:
        """The last episodes, to be replayed. Raises UserError if there is no step yet."""
        ...

    def start(self) -> LiveSession:
        """Begins; returns itself."""
        ...

    def close(self) -> None:
        """Ends the simulation, which closes its environment."""
        ...
