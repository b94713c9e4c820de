"""The server's own rules: ports, policies on offer, and seats, without a browser."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import msgspec.msgpack
import numpy as np
import pytest
import viser
import zstandard

from madviz.app.page import Page
from madviz.app.panels.comparison import VersusPanel
from madviz.app.panels.policy import PolicyChoice
from madviz.app.panels.training import TrainingPanel
from madviz.app.rates import Rates
from madviz.app.server import App, ExploreConfig, check_port, explore, first_choice
from madviz.app.users import Users
from madviz.bench.visitor import Visitor
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.session.commands import Pause, SetSpeed
from madviz.session.frame import Frame
from madviz.session.session import Session
from madviz.training.job import TrainingJob
from tests.fakes import FakePolicy, policies


def test_a_taken_port_is_named_with_the_flag_that_helps():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"port {port} .*--port"):
            explore(ExploreConfig(port=port))
    check_port("127.0.0.1", port)


def test_an_app_frees_its_port():
    app = App(FakePolicy(), [PolicyChoice("toy-mad", "MAD")], policies)
    port = app.server.get_port()
    assert app.url == f"http://127.0.0.1:{port}"
    with pytest.raises(UserError, match="cannot be served"):
        check_port("127.0.0.1", port)
    app.stop()
    check_port("127.0.0.1", port)


def test_no_message_looks_as_if_it_were_part_of_an_animation():
    """viser's page holds back what was written within 0.1 s of the message before it."""
    app = App(FakePolicy(), [PolicyChoice("toy-mad", "MAD")], policies, speed=40.0)
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


class Browser:
    """A client that nobody looks through: it draws into the server's own widgets."""

    def __init__(self, number: int, server: viser.ViserServer) -> None:
        self.client_id, self.gui, self.scene = number, server.gui, server.scene
        self.atomic, self.flush = server.atomic, server.flush
        self.camera = SimpleNamespace(
            **{"image_width": 1280, "image_height": 800, "position": np.zeros(3)},
            on_update=lambda callback: None,
        )
        self._websock_connection = SimpleNamespace(queue_message=lambda message: None)


class Lobby:
    """A server whose visitors come and go as a test says."""

    def __init__(self) -> None:
        self.real = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        self.present: dict[int, Browser] = {}

    def on_client_connect(self, callback) -> None:
        self.join = callback

    def on_client_disconnect(self, callback) -> None:
        self.leave = callback

    def get_clients(self) -> dict[int, Browser]:
        return dict(self.present)

    def come(self, number: int) -> Browser:
        browser = self.present[number] = Browser(number, self.real)
        self.join(browser)
        return browser

    def go(self, number: int) -> None:
        self.leave(self.present.pop(number))


@contextlib.contextmanager
def users(cap: int):
    lobby = Lobby()
    made: list[Session] = []

    def new_session() -> Session:
        made.append(Session(make_env, FakePolicy(), policies, speed=2.0))
        return made[-1]

    choices = [PolicyChoice("toy-mad", "MAD")]
    job = TrainingJob(Path("runs"))
    one = Users(lobby, new_session, choices, Rates(), job, cap)  # type: ignore[arg-type]
    yield one, lobby, made
    one.close()
    lobby.real.stop()


def test_a_simulation_waits_before_anybody_comes():
    with users(cap=2) as (them, lobby, made):
        assert len(made) == 1
        lobby.come(1)
        assert len(made) == 1 and them.session_of(1) is made[0]


def test_everybody_has_their_own_until_the_cap():
    with users(cap=2) as (them, lobby, made):
        for number in (1, 2, 3, 4):
            lobby.come(number)
        assert (them.sessions, them.watchers, len(made)) == (2, 2, 2)
        # Watchers are spread over the simulations there are.
        assert {id(them.session_of(3)), id(them.session_of(4))} == {id(one) for one in made}


def test_who_leaves_frees_a_thread_and_watchers_inherit():
    with users(cap=1) as (them, lobby, made):
        lobby.come(1)
        lobby.come(2)
        lobby.come(3)
        assert (them.sessions, them.watchers) == (1, 2)
        lobby.go(1)
        assert (them.sessions, them.watchers) == (1, 1)
        assert made[0]._thread is not None and not made[0]._thread.is_alive()
        assert them.session_of(2) is made[1] and them.session_of(3) is made[1]
        lobby.go(3)
        assert (them.sessions, them.watchers) == (1, 0)


def test_who_left_before_sitting_down_keeps_no_seat():
    with users(cap=2) as (them, lobby, made):
        browser = Browser(7, lobby.real)
        lobby.join(browser)
        assert them.sessions == 0
        lobby.leave(browser)
        assert not any(session._thread.is_alive() for session in made if session._thread)


def test_who_leaves_before_their_page_starts_leaves_nothing_to_listen(monkeypatch):
    with users(cap=2) as (them, lobby, _):
        browser, start = Browser(7, lobby.real), Page.start

        def late(page: Page) -> None:
            lobby.leave(browser)
            start(page)

        monkeypatch.setattr(Page, "start", late)
        lobby.join(browser)
        assert them.sessions == 0 and them._shared.rates._listeners == ()


def test_a_page_that_is_closed_stops_drawing():
    before = set(threading.enumerate())
    with users(cap=1) as (_, lobby, made):
        lobby.come(1)
        deadline = time.monotonic() + 20
        while not isinstance(made[0].latest, Frame) and time.monotonic() < deadline:
            time.sleep(0.01)
        pages = [t for t in threading.enumerate() if t.name == "madviz-page" and t not in before]
        lobby.go(1)
        assert pages and not any(page.is_alive() for page in pages)


def test_a_panel_that_cannot_be_built_is_tried_once_and_said(monkeypatch):
    tries: list[int] = []

    def broken(*_) -> None:
        tries.append(1)
        raise RuntimeError("no such widget")

    monkeypatch.setattr("madviz.app.layout.KeepPanel", broken)
    with users(cap=1) as (them, lobby, made):
        lobby.come(1)
        made[0].send(SetSpeed(None))
        page = them._seats[1].page
        await_that(lambda: bool(tries))
        frames = getattr(made[0].latest, "number", 0)
        await_that(lambda: getattr(made[0].latest, "number", 0) >= frames + 15)
        assert len(tries) == 1
        assert page._waiting is not None and "no such widget" in page._waiting.content


def test_a_training_is_followed_while_the_episode_stands_still(monkeypatch):
    looks: list[int] = []
    real = TrainingPanel.update

    def update(panel: TrainingPanel, frame: Frame):
        looks.append(frame.number)
        return real(panel, frame)

    monkeypatch.setattr(TrainingPanel, "update", update)
    with users(cap=1) as (_, lobby, made):
        lobby.come(1)
        made[0].send(Pause())
        # Looked at again, with the same frame.
        await_that(lambda: len(looks) >= 6 and looks[-1] == looks[-2] == looks[-3])


def test_tables_make_way_for_somebody_who_has_touched_a_camera(monkeypatch):
    looks: list[int] = []
    monkeypatch.setattr(VersusPanel, "update", lambda panel, frame: looks.append(1) or [])
    with users(cap=1) as (them, lobby, made):
        lobby.come(1)
        made[0].send(Pause())
        await_that(lambda: bool(looks))
        page = them._seats[1].page
        await_that(lambda: getattr(made[0].latest, "phase", "") == "paused")
        frame = made[0].latest
        assert frame is not None
        page._drawing.acquire()  # Nobody else draws from here on.
        looks.clear()
        assert page._panels is not None
        for shown in page._panels.shown:
            shown.done, shown.number = -1e9, 0
        page._hurried.set()
        page._push(frame, time.monotonic())
        assert not looks  # A frame that nobody waits for ends where somebody begins to.
        page._hurried.clear()
        page._push(frame, time.monotonic())
        assert looks == [1]
        page._drawing.release()


def await_that(happened, patience: float = 20.0) -> None:
    deadline = time.monotonic() + patience
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.01)
