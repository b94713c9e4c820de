"""Who is on the page: a simulation for each visitor, up to a cap; beyond it, a seat to watch from.

A closed page gives back its thread, its environment and its memory. Whoever watched it then gets a
simulation of their own. In presenter mode there is one simulation, which nobody owns: whoever
``presents`` has the controls, in every page they open, all others watch, and it goes on while
nobody looks. Seats to watch from end, too; who finds none is told so, and sits down when somebody
leaves.

A simulation that ends leaves 7 MB of pictures and messages in cycles of objects, and the allocator
keeps what it once had: without ``give_back``, 70 visits in three minutes cost 30 MB for good.

Everything personal lives in ``client.gui`` and ``client.scene``; viser's server-wide widgets would
be shared by all.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import viser

from madviz.app.browser import equip
from madviz.app.layout import Shared
from madviz.app.page import Page, waiting_html
from madviz.app.panels.policy import PolicyChoice
from madviz.app.rates import Rates
from madviz.app.viser_patches import patch_rendering
from madviz.session.session import Session
from madviz.system.processes import give_back
from madviz.training.job import TrainingJob

log = logging.getLogger(__name__)

WATCHING = (
    "You are watching: all {} simulations here are taken. You get one of your own as soon as the "
    "visitor you are watching leaves."
)
PRESENTED = "You are watching a presentation: the presenter has the controls."
FULL = "All {} seats to watch from are taken. You get one as soon as somebody leaves."
TIDY_AFTER = 0.5
"""Seconds from when somebody leaves to when memory is given back."""


@dataclass
class Seat:
    """One browser: its page, and whether it has the controls of the session it shows."""

    client: viser.ClientHandle
    page: Page
    session: Session
    owner: bool


class Users:
    """Seats people as they come, frees what they leave."""

    def __init__(
        self,
        server: viser.ViserServer,
        new_session: Callable[[], Session],
        choices: Sequence[PolicyChoice],
        rates: Rates,
        job: TrainingJob,
        cap: int,
        watchers: int = 50,
        presents: Callable[[viser.ClientHandle], bool] | None = None,
    ) -> None:
        """``cap`` simulations and ``watchers`` seats beside them. ``presents`` tells the presenter
        from the others; None: there is no presenter."""
        self._server, self._new_session = server, new_session
        self._shared = Shared(choices, rates, job)
        self._cap, self._most_watchers, self._presents = cap, watchers, presents
        self._seats: dict[int, Seat] = {}
        self._standing: dict[int, tuple[viser.ClientHandle, viser.GuiHtmlHandle]] = {}
        """Who found no seat, and the line that tells them."""
        self._tidying: threading.Timer | None = None
        self._lock = threading.Lock()
        """Guards all of these; never held while a widget is assigned."""
        self._spare: Session | None = new_session().start()
        """Started before anybody comes, so that the first picture is ready when somebody does. In
        presenter mode it stays here: it is the one that is presented."""
        server.on_client_connect(self.join)
        server.on_client_disconnect(self.leave)

    @property
    def sessions(self) -> int:
        """Pages that have the controls of a simulation."""
        with self._lock:
            return sum(seat.owner for seat in self._seats.values())

    @property
    def watchers(self) -> int:
        with self._lock:
            return sum(not seat.owner for seat in self._seats.values())

    def session_of(self, client_id: int) -> Session | None:
        """The session a browser shows, if it has a seat."""
        with self._lock:
            seat = self._seats.get(client_id)
        return seat.session if seat else None

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
                self._seats[client.client_id] = Seat(client, page, session, owner)
        if place is None:
            line = client.gui.add_html(waiting_html(FULL.format(self._most_watchers)))
            with self._lock:
                self._standing[client.client_id] = (client, line)
        else:
            try:
                page.start()
            except Exception:
                self.leave(client)
                raise
        if client.client_id not in self._server.get_clients():
            self.leave(client)  # It left while its page was being made.

    def _place(self, presents: bool) -> tuple[Session, bool] | None:
        """The session for one more browser, and whether it gets the controls; None: no seat left.
        Called with the lock held."""
        seats = self._seats.values()
        owners = [seat.session for seat in seats if seat.owner]
        watched = [seat.session for seat in seats if not seat.owner]
        if self._presents is None and len(owners) < self._cap:
            session, self._spare = self._spare or self._new_session().start(), None
            return session, True
        if not presents and len(watched) >= self._most_watchers:
            return None
        if self._presents is not None:
            assert self._spare is not None
            return self._spare, presents
        return min(owners, key=watched.count), False

    def _watching_words(self) -> str:
        return PRESENTED if self._presents is not None else WATCHING.format(self._cap)

    def leave(self, client: viser.ClientHandle) -> None:
        """Frees what a browser had; those who watched it, or waited, sit down anew."""
        with self._lock:
            self._standing.pop(client.client_id, None)
            seat = self._seats.pop(client.client_id, None)
            if seat is None:
                return
            theirs = seat.owner and self._presents is None
            stranded = [other for other in self._seats.values() if other.session is seat.session]
            stranded = stranded if theirs else []
            for other in stranded:
                del self._seats[other.client.client_id]
            standing, self._standing = list(self._standing.values()), {}
        seat.page.close()
        if theirs:
            seat.session.close()
        for other in stranded:
            other.page.close()
            other.page.clear()
            self.join(other.client)
        for waiting, line in standing:
            line.remove()
            self.join(waiting)
        self._tidy_soon()

    def _tidy_soon(self) -> None:
        """Gives memory back once those who call are done: as long as they run they hold on to the
        page that they close, and all that hangs on it."""
        with self._lock:
            if self._tidying is None:
                self._tidying = threading.Timer(TIDY_AFTER, self._tidy)
                self._tidying.name, self._tidying.daemon = "madviz-tidy", True
                self._tidying.start()

    def _tidy(self) -> None:
        with self._lock:
            self._tidying = None
        give_back()

    def close(self) -> None:
        """Frees everything."""
        with self._lock:
            if self._tidying is not None:
                self._tidying.cancel()
            seats, self._seats = list(self._seats.values()), {}
            spare, self._spare = self._spare, None
        for seat in seats:
            seat.page.close()
        theirs = [seat.session for seat in seats if seat.owner and seat.session is not spare]
        for session in theirs + ([spare] if spare else []):
            session.close()
