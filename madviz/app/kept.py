"""The sessions of visitors whose connection ended: kept for a while, for those who come back.

A browser whose connection was cut comes again as another visitor, with a simulation of its own. Its
page still knows the name of the visit before (``browser/returned.js``), and may ask for what was
played there as a file. The name has 128 random bits, so nobody else does.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from http import HTTPStatus
from urllib.parse import urlsplit

from websockets.http11 import Request, Response

from madviz.app.proxies import query_of, text
from madviz.errors import UserError
from madviz.session.live_session import LiveSession

SESSION = "/madviz-session"
KEEPS = 600.0
"""Seconds for which a session is kept."""
MOST_KEPT = 20
GONE = "This session is not kept any more, or its end has not been noticed yet: try again."


class KeptSessions:
    """Saved sessions by the name of their visit. From any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._kept: OrderedDict[str, tuple[float, str]] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, visit: str, session: LiveSession) -> None:
        """Saves the last episodes of ``session``, before it is closed."""
        try:
            saved = session.save().to_json()
        except UserError:  # There is no step yet, or its process is gone.
            return
        with self._lock:
            self._kept[visit] = (self._clock(), saved)
            while len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)

    def of(self, visit: str) -> str | None:
        """The file, as text; None where there is none any more."""
        with self._lock:
            since, saved = self._kept.get(visit, (0.0, None))
            if saved is not None and self._clock() - since > KEEPS:
                del self._kept[visit]
                return None
            return saved

    def answer(self, request: Request) -> Response | None:
        """The file that is asked for; None where something else is."""
        if urlsplit(request.path).path != SESSION:
            return None
        saved = self.of(query_of(request).get("visit", ""))
        if saved is None:
            return text(HTTPStatus.NOT_FOUND, GONE, "text/plain")
        return text(HTTPStatus.OK, saved, "application/json")
