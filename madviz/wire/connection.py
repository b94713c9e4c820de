"""A websocket to a served policy: a question goes out, an answer comes back, or one sentence says
which address did not do what was expected of it."""

from __future__ import annotations

import logging
import socket
import struct
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidURI
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from madviz.errors import UserError
from madviz.system.address import ServerAddress
from madviz.wire.codec import MOST_BYTES, BadMessage, Protocol, pack, unpack

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)  # Below that, websockets writes down the address with its secrets.

OURS = Subprotocol("madviz.vla-eval")
"""The subprotocol that two programs of madviz agree on before the first message."""
OPENING = 10.0
"""Seconds to connect in."""
FIRST = 60.0
"""Seconds that the very first answer may take: many servers compile then."""


class PolicyConnection:
    """A connection that opens itself when it is used, and is closed by anything unexpected: what
    comes after a late or broken answer would be taken for the answer to another question."""

    def __init__(self, address: ServerAddress, timeout: float) -> None:
        self.address = address
        self._timeout = timeout
        self._socket: ClientConnection | None = None
        self.answered = False
        """Whether the server has computed an answer before, and so needs no time to get ready."""

    @property
    def is_open(self) -> bool:
        return self._socket is not None

    def open(self) -> bool:
        """Connects; whether the other side is madviz's own. Raises UserError."""
        self.close()
        try:
            opened = connect(
                self.address.whole,
                subprotocols=[OURS],
                compression=None,
                max_size=MOST_BYTES,
                open_timeout=OPENING,
                close_timeout=1.0,
                ping_interval=None,  # A server that computes does not answer pings.
                proxy=None,
                logger=_log,
            )
        except (OSError, TimeoutError, InvalidHandshake, InvalidMessage, EOFError) as error:
            why = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise self.wrong("a policy that is served", f"no connection ({why:.100})") from error
        except (InvalidURI, ValueError):
            raise self.wrong("ws://HOST:PORT", "something else") from None
        # Of sending alone: a limit of the whole socket would end a connection that only waits.
        limit = struct.pack("ll", int(self._timeout), int(self._timeout % 1 * 1e6))
        opened.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        self._socket = opened
        return opened.subprotocol == OURS

    def close(self) -> None:
        """Hangs up; the next question connects again."""
        opened = self._socket
        self._socket = None
        if opened is not None:
            opened.close()

    def tell(self, message: Any, protocol: Protocol) -> None:
        """Sends what needs no answer. Raises UserError, and hangs up, where it is not taken in
        time."""
        assert self._socket is not None
        try:
            self._socket.send(pack(message, protocol))
        except ConnectionClosed as gone:
            if isinstance(gone.__cause__, BlockingIOError):
                what = f"a server that reads within {self._timeout:g} s"
                raise self.wrong(what, "one that does not", "see `timeout` of --wire") from None
            raise self._gone("an open connection", gone) from None

    def hear(self, expected: str, within: float | None = None) -> Any:
        """The next message. Raises UserError, and hangs up, where none comes in time, or one that
        cannot be read."""
        assert self._socket is not None
        longer = within is None and not self.answered
        patience = max(FIRST, self._timeout) if longer else within or self._timeout
        try:
            found = unpack(self._socket.recv(patience))
        except TimeoutError as late:
            raise self.wrong(
                f"{expected} within {patience:g} s", "nothing", "see `timeout` of --wire"
            ) from late
        except ConnectionClosed as gone:
            raise self._gone(expected, gone) from None
        except BadMessage as bad:
            raise self.wrong(expected, str(bad)) from None
        self.answered = self.answered or within is None
        return found

    def heard_first(self, within: float) -> Any:
        """The message that the other side sends by itself; None where it waits to be spoken to."""
        assert self._socket is not None
        try:
            return unpack(self._socket.recv(within))
        except TimeoutError:
            return None
        except ConnectionClosed as gone:
            raise self._gone("a policy that is served", gone) from None
        except BadMessage as bad:
            raise self.wrong("a greeting", str(bad)) from None

    def wrong(self, expected: str, found: str, move: str = "look at the server") -> UserError:
        """The error to raise, from None: what a server says may hold the secret that it was sent.
        The connection is closed."""
        self.close()
        said = self.address.hide(found)
        return UserError(f"{self.address}: expected {expected}, found {said}; {move}")

    def _gone(self, expected: str, gone: ConnectionClosed) -> UserError:
        if gone.sent is not None and gone.sent.code == 1009:
            return self.wrong(expected, f"a message of more than {MOST_BYTES >> 20} MB")
        frame = gone.rcvd or gone.sent
        why = f" ({frame.code} {frame.reason:.60})".replace(" )", ")") if frame else ""
        return self.wrong(
            expected, f"that the connection was closed{why}", "start the server and try again"
        )
