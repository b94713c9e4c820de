"""Who is on the page: a simulation for each visitor, up to a limit; beyond it, visitors watch.

A closed page gives back its thread, its environment and its memory. Whoever watched it then gets a
simulation of their own. In presenter mode there is one simulation, which nobody owns: whoever
``presents`` has the controls, in every page they open, all others watch, and it goes on while
nobody looks. Watchers have a limit, too: who comes after that waits until somebody leaves.

A simulation that ends leaves 7 MB of pictures and messages in cycles of objects, and the allocator
holds on to what it once had: without ``release_memory``, 70 visits in three minutes cost 30 MB for
good.

Everything personal lives in ``client.gui`` and ``client.scene``; viser's server-wide widgets would
be shared by all.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import viser

from madviz.app.browser import equip, note_visit
from madviz.app.kept import KeptSessions
from madviz.app.layout import Shared
from madviz.app.page import Page, waiting_html
from madviz.app.viser_patches import patch_rendering
from madviz.session.live_session import LiveSession
from madviz.system.hosts import new_token
from madviz.system.processes import release_memory

WATCHING = (
    "You are watching: all {} simulations here are taken. You get one of your own as soon as the "
    "visitor you are watching leaves."
)
PRESENTED = "You are watching a presentation: the presenter has the controls."
FULL = "All {} places for watchers are taken. You get one as soon as somebody leaves."
MOST_WAITING = 100
"""Browsers that may wait for a place; more get status 503."""
TIDY_AFTER = 0.5
"""Seconds from when somebody leaves to when memory is given back."""


@dataclass(frozen=True)
class Limits:
    """How many browsers a server shows something to; the others wait."""

    visitors: int = 4
    """Those with a simulation of their own."""
    watchers: int = 50
    """Those who watch somebody else's."""


@dataclass
class Visit:
    """One browser: its page, and whether it has the controls of the session it shows."""

    client: viser.ClientHandle
    page: Page
    session: LiveSession
    owner: bool
    name: str = field(default_factory=new_token)


class Users:
    """Gives each browser a page as it comes, and frees what it leaves."""

    def __init__(
        self,
        server: viser.ViserServer,
        new_session: Callable[[], LiveSession],
        shared: Shared,
        limits: Limits,
        presents: Callable[[viser.ClientHandle], bool] | None = None,
    ) -> None:
        """``presents`` tells the presenter from the others; None: there is no presenter."""
        self._server = server
        self._new_session = new_session
        self._shared = shared
        self._limits = limits
        self._presents = presents
        self.kept = KeptSessions()
        self._visits: dict[int, Visit] = {}
        self._queue: dict[int, tuple[viser.ClientHandle, viser.GuiHtmlHandle]] = {}
        """Who found no place, and the line that says so."""
        self._tidying: threading.Timer | None = None
        self._lock = threading.Lock()
        """Guards all of these; never held while a widget is assigned."""
        self._spare: LiveSession | None = new_session().start()
        """Started before anybody comes, so that the first picture is ready when somebody does. In
        presenter mode it stays here: it is the one that is presented."""
        server.on_client_connect(self.join)
        server.on_client_disconnect(self.leave)

    def join(self, client: viser.ClientHandle) -> None:
        """Gives a browser a simulation, or somebody else's to watch, or a place to wait."""
        equip(client)
        patch_rendering(client)
        presents = self._presents is not None and self._presents(client)
        with self._lock:
            place = self._place(presents)
            if place is not None:
                session, owner = place
                page = Page(
                    client,
                    session,
                    self._shared,
                    notice="" if owner else self._watching_words(),
                    readonly=not owner,
                )
                visit = Visit(client, page, session, owner)
                self._visits[client.client_id] = visit
        if place is None:
            line = client.gui.add_html(waiting_html(FULL.format(self._limits.watchers)))
            with self._lock:
                self._queue[client.client_id] = (client, line)
        else:
            note_visit(client, visit.name if owner and self._presents is None else "")
            try:
                page.start()
            except Exception:
                self.leave(client)
                raise
        if client.client_id not in self._server.get_clients():
            self.leave(client)  # It left while its page was being made.

    def _place(self, presents: bool) -> tuple[LiveSession, bool] | None:
        """The session for one more browser, and whether it gets the controls; None: all places
        are taken. Called with the lock held."""
        visits = self._visits.values()
        owners = [visit.session for visit in visits if visit.owner]
        watched = [visit.session for visit in visits if not visit.owner]
        if self._presents is None and len(owners) < self._limits.visitors:
            session = self._spare or self._new_session().start()
            self._spare = None
            return session, True
        if not presents and len(watched) >= self._limits.watchers:
            return None
        if self._presents is not None:
            assert self._spare is not None
            return self._spare, presents
        return min(owners, key=watched.count), False

    def _watching_words(self) -> str:
        return PRESENTED if self._presents is not None else WATCHING.format(self._limits.visitors)

    def leave(self, client: viser.ClientHandle) -> None:
        """Frees what a browser had; those who watched it, or waited, get a place anew."""
        with self._lock:
            self._queue.pop(client.client_id, None)
            visit = self._visits.pop(client.client_id, None)
            if visit is None:
                return
            theirs = visit.owner and self._presents is None
            stranded = [other for other in self._visits.values() if other.session is visit.session]
            stranded = stranded if theirs else []
            for other in stranded:
                del self._visits[other.client.client_id]
            queue = list(self._queue.values())
            self._queue = {}
        visit.page.close()
        if theirs:
            self.kept.keep(visit.name, visit.session)
            visit.session.close()
        for other in stranded:
            other.page.close()
            other.page.clear()
            self.join(other.client)
        for waiting, line in queue:
            line.remove()
            self.join(waiting)
        self._tidy_soon()

    def _tidy_soon(self) -> None:
        """Gives memory back once those who call are done: as long as they run they hold on to the
        page that they close, and all that hangs on it."""
        with self._lock:
            if self._tidying is None:
                self._tidying = threading.Timer(TIDY_AFTER, self._tidy)
                self._tidying.name = "madviz-tidy"
                self._tidying.daemon = True
                self._tidying.start()

    def _tidy(self) -> None:
        with self._lock:
            self._tidying = None
        release_memory()

    def close(self) -> None:
        """Frees everything."""
        with self._lock:
            if self._tidying is not None:
                self._tidying.cancel()
            visits = list(self._visits.values())
            self._visits = {}
            spare = self._spare
            self._spare = None
        for visit in visits:
            visit.page.close()
        theirs = [visit.session for visit in visits if visit.owner and visit.session is not spare]
        for session in theirs + ([spare] if spare else []):
            session.close()
