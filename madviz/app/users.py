"""Who is on the page: a simulation for each visitor, up to a cap; beyond it, a seat to watch from.

A closed page gives back its thread, its environment and its memory. Whoever watched it then gets a
simulation of their own. Everything personal lives in ``client.gui`` and ``client.scene``; viser's
server-wide widgets would be shared by all.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import viser

from madviz.app.page import Page
from madviz.app.policy import PolicyChoice
from madviz.app.rates import Rates
from madviz.session import Session
from madviz.training_job import TrainingJob

log = logging.getLogger(__name__)


@dataclass
class Seat:
    """One browser: its page, and whether the session it shows is its own."""

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
    ) -> None:
        self._server, self._new_session = server, new_session
        self._choices, self._rates, self._cap = choices, rates, cap
        self._job = job
        self._seats: dict[int, Seat] = {}
        self._lock = threading.Lock()
        """Guards ``_seats`` and ``_spare``; never held while a widget is assigned."""
        self._spare: Session | None = new_session().start()
        """Started before anybody comes, so that the first picture is ready when somebody does."""
        server.on_client_connect(self.join)
        server.on_client_disconnect(self.leave)

    @property
    def sessions(self) -> int:
        """Simulations that belong to a visitor."""
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
        """Gives a browser a simulation, or somebody else's to watch."""
        with self._lock:
            owners = [seat.session for seat in self._seats.values() if seat.owner]
            owner = len(owners) < self._cap
            if owner:
                session, self._spare = self._spare or self._new_session().start(), None
            else:
                watched = [seat.session for seat in self._seats.values() if not seat.owner]
                session = min(owners, key=watched.count)
            notice = "" if owner else watching_words(self._cap)
            page = Page(
                *(client, session, self._choices, self._rates, self._job),
                notice=notice,
                readonly=not owner,
            )
            self._seats[client.client_id] = Seat(client, page, session, owner)
        page.start()
        if client.client_id not in self._server.get_clients():
            self.leave(client)  # It left while its page was being made.

    def leave(self, client: viser.ClientHandle) -> None:
        """Frees what a browser had; those who watched it sit down anew."""
        with self._lock:
            seat = self._seats.pop(client.client_id, None)
            if seat is None:
                return
            stranded = [other for other in self._seats.values() if other.session is seat.session]
            stranded = stranded if seat.owner else []
            for other in stranded:
                del self._seats[other.client.client_id]
        seat.page.close()
        if seat.owner:
            seat.session.close()
        for other in stranded:
            other.page.close()
            other.page.clear()
            self.join(other.client)

    def close(self) -> None:
        """Frees everything."""
        with self._lock:
            seats, self._seats = list(self._seats.values()), {}
            spare, self._spare = self._spare, None
        for seat in seats:
            seat.page.close()
        for session in [seat.session for seat in seats if seat.owner] + ([spare] if spare else []):
            session.close()


def watching_words(cap: int) -> str:
    """What a visitor over the cap is told."""
    return (
        f"You are watching: all {cap} simulations here are taken. You get one of your own as soon "
        "as the visitor you are watching leaves."
    )
