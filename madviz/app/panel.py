"""The panels of a page, and how their changes reach a browser.

A panel builds its widgets into the container it is given, owns their handles and nothing else.
``update`` only computes; what it returns is assigned afterwards, all panels at once, inside one
``atomic`` block, so that a browser never shows half a frame and an exception never leaves the
block open.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from madviz.app.connection import is_too_late
from madviz.session.commands import Command
from madviz.session.frame import Frame, NoFrame

Send = Callable[[Command], None]
"""Sends a command to the simulation; where a panel takes None instead, it is read-only."""
Newest = Callable[[], Frame | NoFrame | None]
"""Gives what the page shows last."""


class Assign(NamedTuple):
    """``setattr(handle, name, value)``, later."""

    handle: Any
    name: str
    value: Any


class Panel(Protocol):
    """A part of the page. One that also has a true ``unsettled`` is updated again although there is
    no newer frame: what it showed depended on the time."""

    def update(self, frame: Frame) -> list[Assign]:
        """The changes by which the page shows ``frame``. Assigns nothing itself."""
        ...

    def remove(self) -> None:
        """Takes all its widgets off the page."""
        ...

    def note(self, frame: Frame) -> None:
        """Gets every frame that the page shows, also where ``update`` is not due: a curve has a
        point for each. By default a panel does nothing with it."""


def apply(changes: list[Assign]) -> None:
    """Assigns, leaving out what is there already; inside an ``atomic`` block. What another thread
    has taken off the page meanwhile is left out, too."""
    for handle, name, value in changes:
        try:
            setattr(handle, name, value)
        except RuntimeError as error:
            if not is_too_late(error):
                raise
