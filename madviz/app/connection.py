"""Limits for a visitor's websocket, of messages that come and that wait: memory has a bound.

The problem: viser takes messages that no page here sends. One asks for a public address of this
server, one begins an upload of any size, one goes on to all other visitors. It reads as fast as
somebody sends: whatever a message sets off is kept until somebody has time for it. And it keeps
what it has for a browser that reads nothing, for ever: its pings wait behind all the rest.

The idea: only the kinds in ``TAKEN`` reach viser; whoever sends another one is let go. Reading has
a pace: who sends faster is read later, and their messages stay in their own computer, because a
websocket whose reader waits takes 16 messages and then no more. Whoever takes nothing for
``PATIENCE``, or lets ``MOST_UNSENT`` messages pile up, is let go, too.

    16 x LARGEST    1 MB wait to be read
    MOST_UNSENT     10,000 messages wait to be sent, the newest of each widget: some 10 MB; a page
                    is built of 500
    PACE            100 messages a second become callbacks; a command of one waits in the
                    simulation, 1,000 of them at most (session/session.py)

What such a message breaks is that page's own. The log gets one line for each visitor and kind of
mistake: somebody who sends a thousand bad values must not fill a disk.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any
from weakref import WeakKeyDictionary, WeakValueDictionary

import msgspec.msgpack
import viser
from viser._messages import FileTransferPart
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.typing import Data

LARGEST = 2**16
"""Bytes of the longest message a page may send; viser's own 50 MB are for rendered pictures."""
PACE = 100
BURST = 300
"""Messages a second that are read, and how many at once after a silence. A slider that is dragged
sends 20 a second, a key that is held 30."""
PATIENCE = 20.0
"""Seconds in which a browser takes a part of what is sent to it."""
MOST_UNSENT = 10_000
"""Messages that wait to be sent to one browser."""
TAKEN = frozenset(
    {
        "ViewerCameraMessage",
        "GuiUpdateMessage",
        "CommandTriggerMessage",
        "SceneNodeClickMessage",
        "TransformControlsDragStartMessage",
        "TransformControlsUpdateMessage",
        "TransformControlsDragEndMessage",
    }
)
"""The kinds of messages that the page sends: where one looks from, widgets, keys, clicks on a
frustum, and a camera that is moved by its arrows. A page that sends more must add it here."""
CROSSED = "deque mutated during iteration"
"""The words of asyncio's error where an event is set from another thread."""
MISTAKES = (ArithmeticError, AssertionError, LookupError, TypeError, ValueError)
"""The errors that a message raises which no page sends."""

log = logging.getLogger(__name__)
_noted: WeakKeyDictionary[Any, set[str]] = WeakKeyDictionary()
"""By page, which is viser's connection of it: the kinds of mistakes that the log has."""


class Pace:
    """When the next message may be read."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due = clock()

    def wait(self) -> float:
        """Seconds to wait before the message that has come is handed on."""
        now = self._clock()
        self._due = max(self._due, now - BURST / PACE) + 1 / PACE
        return max(0.0, self._due - now)


class PageConnection(ServerConnection):
    """A visitor's websocket, from which viser reads only what a page sends, at a page's pace."""

    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        self._pace = Pace()

    async def recv(self, decode: bool | None = None) -> Data:  # pyright: ignore[reportIncompatibleMethodOverride]
        data = await super().recv(decode)
        check_kind(data)
        await asyncio.sleep(self._pace.wait())
        return data

    async def drain(self) -> None:
        """Waits until the browser has taken most of what was sent; ends the connection if it takes
        nothing. A slow one may take as long as it needs."""
        left = self.transport.get_write_buffer_size()
        while not self.transport.is_closing():
            try:
                async with asyncio.timeout(PATIENCE):
                    return await super().drain()
            except TimeoutError:
                before = left
                left = self.transport.get_write_buffer_size()
                if left >= before:
                    log.warning("let go of a connection: it has taken nothing for %g s", PATIENCE)
                    self.transport.abort()


def check_kind(data: Data) -> None:
    """Raises an exception for what is no message, and for one of a kind that no page sends. It is
    decoded as viser will do it, so that both read the same kind."""
    if not isinstance(data, bytes):
        raise TypeError("expected bytes, found text")
    message = msgspec.msgpack.decode(data)
    kind = message["type"]
    if kind not in TAKEN:
        raise ValueError(f"expected one of {len(TAKEN)} kinds of message, found {kind!r:.60}")
    if kind == "GuiUpdateMessage" and list(message["updates"]) != ["value"]:
        # viser would set any attribute of the widget, those that hold its callbacks too.
        raise ValueError("expected the value of a widget, found something else of it")


def quiet(
    handler: Callable[[ServerConnection], Awaitable[None]],
) -> Callable[[ServerConnection], Awaitable[None]]:
    """``handler``, but a browser that sends what no page sends is let go with one line in the log
    instead of a traceback."""

    async def handle(connection: ServerConnection) -> None:
        try:
            await handler(connection)
        except ConnectionClosed:
            return
        except Exception as error:
            log.warning("let go of a connection: no page sends such a message (%.300r)", error)
            await connection.close(1002, "not a message that a page sends")

    return handle


def note(page: Any, error: Exception) -> bool:
    """A line in the log for the first mistake of its kind on ``page``, with a traceback where the
    mistake may be ours. Returns whether it was the first."""
    kinds = _noted.setdefault(page, set())
    kind = type(error).__name__
    if kind in kinds:
        return False
    kinds.add(kind)
    if isinstance(error, MISTAKES):
        log.warning("a page sent what no page sends (%.300r)", error)
    else:
        log.error("what a page sent was not carried out", exc_info=error)
    return True


def is_too_late(error: Exception) -> bool:
    """Whether it is viser's for a widget that was taken off the page: a visitor touched something
    while the page's own thread took it down, so there is nothing left to show."""
    words = str(error)
    return isinstance(error, RuntimeError) and "Cannot assign" in words and "on a removed" in words


def guard(server: viser.ViserServer) -> None:
    """From now on, a message that viser can make nothing of is noted once for each visitor and kind
    (asyncio would write a traceback for every one), and whoever does not read is let go."""
    inner = server._websock_server
    pages: WeakValueDictionary[int, Any] = WeakValueDictionary()

    def welcome(page: Any) -> None:
        pages[page.client_id] = page
        _forgive(page, pages)
        _bound(page, inner._live_connections[page.client_id])

    inner.on_client_connect(welcome)
    _forgive(inner, pages)


def _forgive(handlers: Any, pages: Mapping[int, Any]) -> None:
    handle = handlers._handle_incoming_message

    async def forgiving(client_id: int, message: Any) -> None:
        try:
            await handle(client_id, message)
        except Exception as error:
            if not is_too_late(error):
                note(pages[client_id], error)

    handlers._handle_incoming_message = forgiving


def _bound(page: Any, connection: ServerConnection) -> None:
    """Lets go of the browser of ``page`` once too much waits for it.

    viser wakes its sender with an asyncio event, from our thread, and asyncio's events do not
    expect that: now and then one is set while the sender stops waiting for it. By then the message
    lies in viser's buffer, so it is enough to wake the sender from its own thread.
    """
    queue = page.queue_message
    waiting = page.get_message_buffer()

    def queue_message(message: Any) -> None:
        if len(waiting.message_from_id) >= MOST_UNSENT and not waiting.done:
            waiting.event_loop.call_soon_threadsafe(connection.transport.abort)
        try:
            queue(message)
        except RuntimeError as error:
            if str(error) != CROSSED:
                raise
            waiting.event_loop.call_soon_threadsafe(waiting.message_event.set)

    page.queue_message = queue_message


def is_downloading(client: viser.ClientHandle) -> bool:
    """Whether a part of a file waits to be sent to this browser."""
    waiting = client._websock_connection.get_message_buffer()
    with waiting.buffer_lock:
        return any(isinstance(one, FileTransferPart) for one in waiting.message_from_id.values())
