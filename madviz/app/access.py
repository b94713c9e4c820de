"""Who may see the page, and who holds the controls: decided before a byte of the page is sent.

The problem: viser serves its files and its websocket to whoever reaches the port, and a browser's
websocket does not carry the page's address, so a token in the address alone would guard nothing.

The idea: cookies do travel with the websocket. Every request passes a gate first:

    GET /?token=T   right  ──►  303 to / without the token, and a cookie that says T
                    wrong  ──►  403; five wrong ones in a second from one address: 429
    anything else   cookie right  ──►  viser answers: a file, or the websocket is opened
                    no cookie     ──►  401 and a small form that asks for the token

A browser opens a websocket to any machine that any page names, this one included, and says in
``Origin`` whose page that was. So, with a token or without, a websocket is opened only for pages
that came from here: another site's page cannot steer what runs on a visitor's own machine.

Whoever owns a name may let it point anywhere, also at 127.0.0.1 a moment after a browser has loaded
a page under it (DNS rebinding). That page then counts as one from here, and only ``Host`` still has
the name it came by. So what serves this machine alone answers to numbers and to localhost, and else
to what a proxy passes on: that has a port of its own, or says so in a header that pages cannot send
with a websocket. What is left open is a tunnel (``ssh -L``) whose port here has another number than
there: it looks like a proxy that says nothing.

There are two tokens. The visitors' lets in; where the page serves beyond this machine, it is there
by default, and where ``MADVIZ_TOKEN`` names one, that is it: a class server sets it, since all of
its accounts reach 127.0.0.1. The presenter's, in presenter mode, also hands over the controls, so a
page that is loaded again has them again. Both are 128 random bits, compared in constant time: at
five tries a second, an even chance to guess one takes 10^30 years.

Nothing here is encrypted: http is for a network that one trusts, or for a tunnel (``ssh -L``).
"""

from __future__ import annotations

import ipaddress
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from html import escape
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any, Literal
from urllib.parse import parse_qsl, urlencode, urlsplit
from weakref import WeakKeyDictionary, WeakSet

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from madviz.app.browser import read
from madviz.app.connection import LARGEST, PageConnection, quiet
from madviz.app.proxies import (
    ENTERED,
    NO_COOKIE,
    arrival,
    comes_from_elsewhere,
    cookie_rules,
    host_of,
    names_of,
    query_of,
    text,
    with_script,
)
from madviz.errors import UserError
from madviz.system.hosts import same_token

Role = Literal["presenter", "visitor"]
TRIES = 5
WINDOW = 1.0
"""Wrong tokens that one address may send in so many seconds."""
MOST = 200
"""Websockets that are open at once, where nothing else is said."""
MOST_ADDRESSES = 1000
"""Addresses whose tries are remembered."""
LONGEST_NAME = 200
"""Letters of a file's name in an address; no disk has names of more than 255 bytes."""
_starting = threading.Lock()

ASKED = "This page needs the token that was printed where it was started."
WRONG = "This is not the token that was printed where the page was started."
FOREIGN = "A page of another site asked for this one; open this address itself."
RENAMED = (
    "This page is for this machine alone; open it as http://127.0.0.1:{}, or start it with --host."
)
TOO_MANY = "Too many wrong tokens from here; wait a second."
CROWDED = "As many pages as this server holds are open; come back later."


class Tries:
    """Counts wrong tokens by address, and forgets them after a second."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._wrong: OrderedDict[str, deque[tuple[float, int]]] = OrderedDict()

    def too_many(self, address: str) -> bool:
        """Whether ``address`` has to wait."""
        past = self._wrong.get(address, ())
        return len(past) == TRIES and self._clock() - past[0][0] < WINDOW

    def note(self, address: str, said: str) -> None:
        """One more wrong token. Who says the same one again guesses nothing: a tab that was open
        before a restart asks once a second, and others may come from its address."""
        past = self._wrong.setdefault(address, deque(maxlen=TRIES))
        self._wrong.move_to_end(address)
        token = hash(said)  # Whole ones, of any length, would fill the memory.
        if all(token != other for _, other in past):
            past.append((self._clock(), token))
        if len(self._wrong) > MOST_ADDRESSES:
            self._wrong.popitem(last=False)


class Gate:
    """See the module. ``visit`` None: everybody may watch. ``present`` None: nobody presents.
    ``local``: what is guarded serves this machine alone."""

    def __init__(
        self, visit: str | None = None, present: str | None = None, local: bool = False
    ) -> None:
        self.visit = visit
        self.present = present
        self.local = local
        self.most = MOST
        """Websockets that may be open at once."""
        self.serves: Callable[[Request], Response | None] = lambda request: None
        """The files that are served beside viser's own, to visitors who were let in."""
        self._open: WeakSet[ServerConnection] = WeakSet()
        self.tries = Tries()
        self._roles: WeakKeyDictionary[ServerConnection, Role] = WeakKeyDictionary()

    def _role_of(self, said: str) -> Role | None:
        """Compares with both, whatever the first one gave: the time taken tells nothing."""
        presents = same_token(said, self.present)
        visits = same_token(said, self.visit)
        return "presenter" if presents else "visitor" if visits else None

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The gate's own answer to a request; None where viser may give its own."""
        port = connection.local_address[1]
        if any(len(part) > LONGEST_NAME for part in request.path.partition("?")[0].split("/")):
            return _refusal(HTTPStatus.REQUEST_URI_TOO_LONG, "This address is too long.")
        if self.local and _is_renamed(request, port):
            return _refusal(HTTPStatus.FORBIDDEN, RENAMED.format(port))
        if _is_websocket(request) and _is_foreign(request):
            return _refusal(HTTPStatus.FORBIDDEN, FOREIGN)
        if (answer := arrival(request, self._crowded)) is not None:
            return answer
        if self.visit is None and self.present is None:
            return self._place(connection, request)
        address = str((connection.remote_address or ("?",))[0])
        query = query_of(request)
        asked = query.get("token")
        carried = _cookie(request, port)
        said = carried if asked is None else asked
        waits = said is not None and self.tries.too_many(address)
        known = None if said is None or waits else self._role_of(said)
        if said is not None and known is None and not waits:
            self.tries.note(address, said)
        if waits and (asked is not None or self.visit):
            return _refusal(HTTPStatus.TOO_MANY_REQUESTS, TOO_MANY)
        if asked is not None and known is None:
            return _refusal(HTTPStatus.FORBIDDEN, WRONG)
        if asked is not None and not _is_websocket(request):
            return _admission(request, port, asked)
        role: Role | None = known or (None if self.visit else "visitor")
        if role is None and ENTERED in query and carried is None:
            return text(HTTPStatus.UNAUTHORIZED, f"<!doctype html><title>madviz</title>{NO_COOKIE}")
        if role is None:
            return _refusal(HTTPStatus.UNAUTHORIZED, ASKED)
        self._roles[connection] = role
        return self._place(connection, request)

    @property
    def _crowded(self) -> str:
        """Why no more websockets are opened; empty if they are."""
        return CROWDED if len(self._open) >= self.most else ""

    def _place(self, connection: ServerConnection, request: Request) -> Response | None:
        """Each open page takes memory, also one that only waits: so there is a most of them."""
        if not _is_websocket(request):
            return self.serves(request)
        if self._crowded:
            return _refusal(HTTPStatus.SERVICE_UNAVAILABLE, self._crowded)
        self._open.add(connection)
        return None

    def _counted(
        self, handler: Callable[[ServerConnection], Awaitable[None]]
    ) -> Callable[[ServerConnection], Awaitable[None]]:
        """``handler``, which gives its place back at its end."""

        async def handle(connection: ServerConnection) -> None:
            try:
                await handler(connection)
            finally:
                self._open.discard(connection)

        return handle

    def presents(self, server: viser.ViserServer, client_id: int) -> bool:
        """Whether a connected browser came with the presenter's token."""
        connection = server._websock_server._live_connections.get(client_id)
        return connection is not None and self._roles.get(connection) == "presenter"

    @contextmanager
    def guarding(self) -> Iterator[None]:
        """Servers of viser that start meanwhile ask this gate first. Raises UserError if one
        started without asking: viser has changed, and an open page must not be taken for a closed
        one."""
        real = websockets.asyncio.server.serve
        hooked = []

        def serve(handler: Any, *words: Any, process_request: Any = None, **options: Any) -> Any:
            hooked.append(True)

            def gated(connection: ServerConnection, request: Request) -> Any:
                refusal = self.answer(connection, request)
                if refusal is not None or process_request is None:
                    return refusal
                return with_script(process_request(connection, request))

            options |= {"max_size": LARGEST, "create_connection": PageConnection}
            return real(self._counted(quiet(handler)), *words, process_request=gated, **options)

        with _starting:
            setattr(websockets.asyncio.server, "serve", serve)  # noqa: B010
            try:
                yield
            finally:
                setattr(websockets.asyncio.server, "serve", real)  # noqa: B010
        if not hooked:
            raise UserError("expected viser 1.1 behind the token, found one that starts otherwise")


def cookie_name(port: int) -> str:
    """Browsers keep cookies by machine, not by port; two pages need two names."""
    return f"madviz-{port}"


def _cookie(request: Request, port: int) -> str | None:
    for line in request.headers.get_all("Cookie"):
        try:
            morsel = SimpleCookie(line).get(cookie_name(port))
        except CookieError:
            continue
        if morsel is not None:
            return morsel.value
    return None


def _is_websocket(request: Request) -> bool:
    return any(word.lower() == "websocket" for word in request.headers.get_all("Upgrade"))


def _is_foreign(request: Request) -> bool:
    """Whether a browser asks for a page that came from elsewhere. What is no browser says nothing,
    and a proxy says under which name it is known."""
    origin = request.headers.get("Origin")
    if origin is None:
        return False
    return host_of(origin) not in names_of(request)


def _is_renamed(request: Request, port: int) -> bool:
    """Whether a browser has come straight to this ``port`` by a name that somebody else may own. A
    number is nobody's; a page cannot add headers to a websocket, and a proxy does."""
    if any(name.lower().startswith(("x-forwarded-", "forwarded")) for name in request.headers):
        return False
    return any(_is_owned(host, port) for host in request.headers.get_all("Host"))


def _is_owned(host: str, port: int) -> bool:
    """Whether ``host`` (``name:port``) is ``port`` under a name other than this machine's own."""
    try:
        asked = urlsplit(f"//{host.strip()}")
        name = (asked.hostname or "").rstrip(".")
        number = asked.port or 80
    except ValueError:
        return True
    if number != port or name == "localhost" or name.endswith(".localhost"):
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return True
    return False


def _admission(request: Request, port: int, token: str) -> Response:
    """Back to the same address without the token, which then stays out of histories and logs."""
    asked = parse_qsl(urlsplit(request.path).query, keep_blank_values=True)
    rest = [(key, value) for key, value in asked if key != "token"]
    if comes_from_elsewhere(request) and ENTERED not in dict(rest):
        rest.append((ENTERED, ""))
    headers = Headers(
        {
            "Location": "./" + ("?" + urlencode(rest) if rest else ""),
            "Set-Cookie": f"{cookie_name(port)}={token}; {cookie_rules(request)}",
            "Referrer-Policy": "no-referrer",
            "Content-Length": "0",
        }
    )
    return Response(HTTPStatus.SEE_OTHER, "See Other", headers, b"")


def _refusal(status: HTTPStatus, why: str) -> Response:
    return text(status, read("token.html").format(escape(why)))
