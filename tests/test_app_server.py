"""The server's own rules: ports, policies on offer, and places, without a browser."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from typing import Any

import msgspec.msgpack
import numpy as np
import pytest
import viser
import zstandard

from benchmarks.visitor import Visitor
from madviz.app.layout import Shared
from madviz.app.page import Page
from madviz.app.panel import Assign, Panel
from madviz.app.panels.breaks import BreakPanel
from madviz.app.panels.policy import PolicyChoice
from madviz.app.panels.training import TrainingPanel
from madviz.app.refresh import AFTER, FASTEST, Refresh, TimedPanel
from madviz.app.server import ExploreConfig, explore, first_choice
from madviz.app.success_rates import SuccessRates
from madviz.app.users import Limits, Users
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.session.commands import Pause, SetSpeed
from madviz.session.frame import Frame
from madviz.session.session import Session
from madviz.system.hosts import check_port
from tests.fakes import FakePolicy, policies
from tests.pages import await_that, browser, choices_of, fake_app, seats, sessions_shown
from tests.sessions import frame_with


def test_a_taken_port_is_named_with_the_flag_that_helps():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"port {port} .*--port"):
            explore(ExploreConfig(port=port))
    check_port("127.0.0.1", port)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"host": ""}, "^--host: expected an address"),
        ({"host": "no such host"}, "on no such host cannot be served"),
        ({"host": "x" * 300}, "cannot be served"),
        ({"host": "a..b"}, "cannot be served"),
        ({"task": "nope", "policy": "metaworld-hammer-mad-light"}, "^unknown task 'nope'"),
        ({"port": 99_999_999}, "^--port: expected a whole number from 0 to 65535"),
        ({"visitors": 0}, "^--visitors: expected"),
        ({"watchers": -1}, "^--watchers: expected"),
        ({"speed": float("nan")}, "^--speed: expected a number above 0"),
    ],
)
def test_what_cannot_be_served_is_refused_in_one_line(change: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said) as caught:
        explore(ExploreConfig(**change))
    assert "\n" not in str(caught.value)


def test_an_app_frees_its_port():
    app = fake_app("toy-mad")
    port = app.server.get_port()
    assert app.url == f"http://127.0.0.1:{port}"
    with pytest.raises(UserError, match="cannot be served"):
        check_port("127.0.0.1", port)
    app.stop()
    check_port("127.0.0.1", port)


def test_no_message_looks_as_if_it_were_part_of_an_animation():
    """viser's page holds back what was written within 0.1 s of the message before it."""
    app = fake_app("toy-mad", speed=40.0)
    stamps: list[float] = []

    class Reader(Visitor):
        def _take(self, data: bytes) -> None:
            packed = data[16 : 16 + int.from_bytes(data[8:16], "little")]
            inner = zstandard.ZstdDecompressor().decompress(packed)
            stamps.append(msgspec.msgpack.decode(inner)["timestampSec"])
            super()._take(data)

    try:
        with Reader(app.url) as visitor:
            await_that(lambda: len(set(visitor.steps)) > 20)
    finally:
        app.stop()
    assert len(stamps) > 20 and np.diff(stamps).min() > 0.1


def test_without_policies_the_next_move_is_named():
    with pytest.raises(UserError, match="madviz train"):
        first_choice([], "metaworld/push")
    assert first_choice([PolicyChoice("one", "One")], None) == "one"


class Lobby:
    """A server whose visitors come and go as a test says."""

    def __init__(self) -> None:
        self.real = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        self.present: dict[int, Any] = {}
        self.rates = Heard()

    def on_client_connect(self, callback) -> None:
        self.join = callback

    def on_client_disconnect(self, callback) -> None:
        self.leave = callback

    def get_clients(self) -> dict[int, Any]:
        return dict(self.present)

    def come(self, number: int) -> Any:
        client = self.present[number] = browser(self.real, number)
        self.join(client)
        return client

    def go(self, number: int) -> None:
        self.leave(self.present.pop(number))


class Heard(SuccessRates):
    """Success rates that know who listens to them."""

    def __init__(self) -> None:
        super().__init__()
        self.listening: set[object] = set()

    def subscribe(self, listener) -> None:
        self.listening.add(listener)
        super().subscribe(listener)

    def unsubscribe(self, listener) -> None:
        self.listening.discard(listener)
        super().unsubscribe(listener)


def ticking() -> list[threading.Thread]:
    """Threads of sessions that have not ended."""
    return [thread for thread in threading.enumerate() if thread.name == "madviz-session"]


@contextlib.contextmanager
def users(cap: int):
    lobby = Lobby()
    made: list[Session] = []

    def new_session() -> Session:
        made.append(Session(make_env, FakePolicy(), policies, speed=2.0))
        return made[-1]

    shared = Shared(choices_of("toy-mad"), lobby.rates)
    one = Users(lobby, new_session, shared, Limits(cap))  # type: ignore[arg-type]
    yield one, lobby, made
    one.close()
    lobby.real.stop()


def test_a_simulation_waits_before_anybody_comes():
    with users(cap=2) as (them, lobby, made):
        assert len(made) == 1
        lobby.come(1)
        assert len(made) == 1 and sessions_shown(them)[1] is made[0]


def test_everybody_has_their_own_until_the_cap():
    with users(cap=2) as (them, lobby, made):
        for number in (1, 2, 3, 4):
            lobby.come(number)
        assert seats(them) == (2, 2, 0) and len(made) == 2
        # Watchers are spread over the simulations there are.
        shown = sessions_shown(them)
        assert {id(shown[3]), id(shown[4])} == {id(one) for one in made}


def test_who_leaves_frees_a_thread_and_watchers_inherit():
    before = set(ticking())
    with users(cap=1) as (them, lobby, made):
        (thread,) = set(ticking()) - before
        lobby.come(1)
        lobby.come(2)
        lobby.come(3)
        assert seats(them) == (1, 2, 0)
        lobby.go(1)
        assert seats(them) == (1, 1, 0)
        assert not thread.is_alive()
        assert sessions_shown(them) == {2: made[1], 3: made[1]}
        lobby.go(3)
        assert seats(them) == (1, 0, 0)


def test_who_left_before_their_page_was_made_has_no_simulation():
    before = set(ticking())
    with users(cap=2) as (them, lobby, _):
        client = browser(lobby.real, 7)
        lobby.join(client)
        assert seats(them) == (0, 0, 0)
        lobby.leave(client)
        assert not set(ticking()) - before


def test_who_leaves_before_their_page_starts_leaves_nothing_to_listen(monkeypatch):
    with users(cap=2) as (them, lobby, _):
        client, start = browser(lobby.real, 7), Page.start

        def late(page: Page) -> None:
            lobby.leave(client)
            start(page)

        monkeypatch.setattr(Page, "start", late)
        lobby.join(client)
        assert seats(them) == (0, 0, 0) and not lobby.rates.listening


def test_a_page_that_is_closed_stops_drawing():
    before = set(threading.enumerate())
    with users(cap=1) as (_, lobby, made):
        lobby.come(1)
        await_that(lambda: isinstance(made[0].latest, Frame))
        pages = [t for t in threading.enumerate() if t.name == "madviz-page" and t not in before]
        lobby.go(1)
        assert pages and not any(page.is_alive() for page in pages)


def test_a_panel_that_cannot_be_built_is_tried_once_and_said(monkeypatch):
    tries: list[int] = []

    def broken(*_) -> None:
        tries.append(1)
        raise RuntimeError("no such widget")

    monkeypatch.setattr("madviz.app.layout.SavePanel", broken)
    with users(cap=1) as (them, lobby, made):
        client = lobby.come(1)
        made[0].send(SetSpeed(None))
        await_that(lambda: bool(tries))
        frames = newest(made[0]).pace.number
        await_that(lambda: newest(made[0]).pace.number >= frames + 15)
        assert len(tries) == 1
        assert "no such widget" in client.gui.html


def test_a_training_is_followed_while_the_episode_stands_still(monkeypatch):
    looks: list[int] = []
    real = TrainingPanel.update

    def update(panel: TrainingPanel, frame: Frame):
        looks.append(frame.pace.number)
        return real(panel, frame)

    monkeypatch.setattr(TrainingPanel, "update", update)
    with users(cap=1) as (_, lobby, made):
        lobby.come(1)
        made[0].send(Pause())
        # Looked at again, with the same frame.
        await_that(lambda: len(looks) >= 6 and looks[-1] == looks[-2] == looks[-3])


def test_a_click_is_kept_that_comes_while_the_page_is_drawn(monkeypatch):
    real = BreakPanel.update
    clicked: list[BreakPanel] = []
    later: list[BreakPanel] = []

    def update(panel: BreakPanel, frame: Frame):
        changes = real(panel, frame)
        if clicked:
            later.append(panel)
        elif frame.pace.phase == "paused":
            panel.show([Assign(panel._folder, "visible", True)])  # As a click's own thread does.
            panel.camera = "first"
            clicked.append(panel)
        return changes

    monkeypatch.setattr(BreakPanel, "update", update)
    with users(cap=1) as (_, lobby, made):
        lobby.come(1)
        made[0].send(Pause())
        await_that(lambda: bool(later) and later[0]._folder.visible)


class Counted(Panel):
    """A panel that counts its updates and the frames it is given."""

    def __init__(self) -> None:
        self.updates = 0
        self.noted = 0

    def note(self, frame: Frame) -> None:
        self.noted += 1

    def update(self, frame: Frame) -> list[Assign]:
        self.updates += 1
        return []

    def remove(self) -> None: ...


def test_tables_make_way_for_somebody_who_has_touched_a_camera():
    picture, table, frame = Counted(), Counted(), frame_with(Pause())
    refresh = Refresh([TimedPanel(picture, FASTEST), TimedPanel(table, 0.5)])
    assert refresh.update(frame, 10.0, lambda: False) == []
    assert (picture.updates, table.updates) == (1, 0), "what is watched all the time goes first"
    assert refresh.wait(frame, 10.0) == pytest.approx(AFTER)
    refresh.update(frame, 10.2, lambda: True)
    assert table.updates == 0, "a frame that nobody waits for ends where somebody begins to"
    refresh.update(frame, 10.2, lambda: False)
    assert (picture.updates, table.updates) == (1, 1)
    assert refresh.wait(frame, 10.2) is None
    refresh.again()
    refresh.update(frame, 11.0, lambda: False)
    assert (picture.updates, table.updates) == (2, 2)
    assert (picture.noted, table.noted) == (4, 4), "every frame goes to every panel of the list"


class Interrupted(Counted):
    """A panel whose first update is interrupted by a click, as the click's thread does it."""

    click: Callable[[], None]

    def update(self, frame: Frame) -> list[Assign]:
        changes = super().update(frame)
        if self.updates == 1:
            self.click()
        return changes


def test_a_click_during_an_update_brings_one_more():
    panel, frame = Interrupted(), frame_with(Pause())
    refresh = Refresh([TimedPanel(panel, FASTEST)])
    panel.click = refresh.again
    refresh.update(frame, 10.0, lambda: False)
    assert refresh.wait(frame, 10.0) is not None
    refresh.update(frame, 11.0, lambda: False)
    assert panel.updates == 2 and refresh.wait(frame, 11.0) is None


def newest(session: Session) -> Frame:
    await_that(lambda: isinstance(session.latest, Frame))
    assert isinstance(session.latest, Frame)
    return session.latest
