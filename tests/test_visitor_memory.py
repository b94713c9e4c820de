"""What a visitor can make the server keep has a bound, whatever they send or do not read."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec.msgpack
import pytest
import viser
from viser._messages import FileTransferPart
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.protocol import State
from websockets.sync.client import connect
from websockets.typing import Subprotocol
from websockets.uri import parse_uri

from benchmarks.visitor import Visitor
from madviz.app import connection
from madviz.app.connection import BURST, LARGEST, PACE, Pace, is_downloading
from madviz.app.server import App
from madviz.app.success_rates import MOST_CONDITIONS, SuccessRates
from madviz.app.toolkit import download, guarded, one_at_a_time
from madviz.app.users import Limits
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.measure import live
from madviz.measure.live import Evaluator
from madviz.observation.ablation import Occlusion
from madviz.observation.condition import Condition
from madviz.observation.schedule import MOST_FAILURES, parse_schedule
from madviz.session.commands import Pause, SetCamera
from madviz.session.live_session import MOST_WAITING
from madviz.session.process import SessionProcess
from madviz.session.session import Session
from tests.fakes import FakePolicy, policies
from tests.pages import browser, fake_app, sessions_shown, until
from tests.sessions import BLACK, OFF


@pytest.fixture(scope="module")
def open_() -> Iterator[App]:
    app = fake_app("toy-mad", "toy-other", limits=Limits(visitors=3), speed=20.0)
    yield app
    app.stop()


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@contextmanager
def deaf(url: str) -> Iterator[None]:
    """A visitor who never reads, and whose computer has little room for what comes."""
    host, port = url.removeprefix("http://").split(":")
    spoken = [Subprotocol(f"viser-v{viser.__version__}")]
    speaks = ClientProtocol(parse_uri(url.replace("http", "ws", 1)), subprotocols=spoken)
    view = {"wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0, "near": 0.1, "far": 9.0}
    view |= {"image_height": 800, "image_width": 1280}
    view |= {"look_at": [0, 0, 0], "up_direction": [0, 0, 1]}
    with socket.socket() as small:
        small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        small.connect((host, int(port)))
        speaks.send_request(speaks.connect())
        small.sendall(b"".join(speaks.data_to_send()))
        while speaks.state is not State.OPEN:
            speaks.receive_data(small.recv(1))
        speaks.send_binary(msgspec.msgpack.encode({"type": "ViewerCameraMessage", **view}))
        small.sendall(b"".join(speaks.data_to_send()))
        yield


def test_messages_are_read_at_a_pace_after_a_burst() -> None:
    now = [100.0]
    pace = Pace(lambda: now[0])
    now[0] = 200.0
    assert [pace.wait() for _ in range(BURST)] == [0.0] * BURST
    waits = [pace.wait() for _ in range(PACE)]
    assert waits == pytest.approx([(n + 1) / PACE for n in range(PACE)])
    now[0] += 1.0 + BURST / PACE
    assert pace.wait() == 0.0


def test_whoever_floods_is_read_later_and_others_go_on(
    open_: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    burst, pace = 40, 10  # What every machine could do more of.
    monkeypatch.setattr(connection, "BURST", burst)
    monkeypatch.setattr(connection, "PACE", pace)
    heard: list[float] = []
    with Visitor(open_.url) as other, Visitor(open_.url) as hostile:
        until(lambda: other.steps and hostile.controls)
        clients = open_.server.get_clients()
        client = clients[max(clients)]
        real = client._websock_connection._handle_incoming_message

        async def count(client_id: Any, message: Any) -> None:
            heard.append(time.monotonic())
            await real(client_id, message)

        client._websock_connection._handle_incoming_message = count
        uuids = list(hostile.controls)
        began, seen = time.monotonic(), len(other.steps)
        flood = threading.Thread(
            target=lambda: [
                hostile.set(uuids[n % len(uuids)], "x" * (LARGEST // 2)) for n in range(3000)
            ],
            daemon=True,
        )
        flood.start()
        until(lambda: len(heard) > burst + 2 * pace)
        seconds = time.monotonic() - began
        assert len(heard) <= burst + pace * (seconds + 1)
        assert open_.server._thread_executor._work_queue.qsize() < 20
        session = sessions_shown(open_.users)[client.client_id]
        assert isinstance(session, Session) and len(session.inbox) <= MOST_WAITING
        until(lambda: len(other.steps) > seen + 5)


def test_whoever_reads_nothing_is_let_go(
    open_: App, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connection, "PATIENCE", 0.3)
    before = set(open_.server.get_clients())
    with (
        caplog.at_level(logging.WARNING),
        Visitor(open_.url) as other,
        deaf(open_.url),
    ):
        until(lambda: other.steps)
        until(lambda: len(set(open_.server.get_clients()) - before) == 2)
        client = open_.server.get_clients()[max(open_.server.get_clients())]
        for _ in range(60):  # More than the system's own buffers hold.
            client.add_notification("A note", os.urandom(100_000).hex())
        until(lambda: len(set(open_.server.get_clients()) - before) == 1)
        assert not other.ended
    (line,) = [r.getMessage() for r in caplog.records]
    assert line == "let go of a connection: it has taken nothing for 0.3 s"


def test_whoever_lets_messages_pile_up_is_let_go(
    open_: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(open_.server.get_clients())
    with Visitor(open_.url) as visitor:
        until(lambda: set(open_.server.get_clients()) - before)
        (number,) = set(open_.server.get_clients()) - before
        client = open_.server.get_clients()[number]
        monkeypatch.setattr(connection, "MOST_UNSENT", 1000)
        with client.atomic():  # As long as this lasts, nothing is sent.
            for line in range(1100):
                client.add_notification("A note", f"number {line}")
            until(lambda: number not in open_.server.get_clients())
        until(lambda: visitor.ended)


def test_there_is_a_most_of_open_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("madviz.app.server.MOST_WAITING", 1)
    app = fake_app("toy-mad", limits=Limits(visitors=1, watchers=0), speed=20.0)
    address = app.url.replace("http", "ws", 1)
    spoken = [Subprotocol(f"viser-v{viser.__version__}")]
    try:
        with Visitor(app.url) as first, Visitor(app.url) as second:
            until(lambda: first.steps and second.texts)
            with pytest.raises(InvalidStatus, match="503"):
                connect(address, subprotocols=spoken)
            assert not first.ended
        until(lambda: not app.server.get_clients())
        with Visitor(app.url) as third:
            until(lambda: third.steps)
    finally:
        app.stop()


def test_a_page_gives_a_widget_a_value_and_nothing_else(open_: App) -> None:
    with Visitor(open_.url) as visitor:
        until(lambda: visitor.controls)
        visitor.set(next(iter(visitor.controls)), [], prop="update_cb")
        until(lambda: visitor.ended, 10.0)


def test_thousands_of_bad_values_are_a_line_for_each_kind(
    open_: App, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with caplog.at_level(logging.WARNING), Visitor(open_.url) as visitor:
        until(lambda: visitor.find("Step") or len(visitor.controls) > 20)
        for n in range(BURST):
            for uuid in list(visitor.controls)[:3]:
                visitor.set(uuid, ["x", {}, None, float("nan"), 1e300, "9" * 50][n % 6])
        until(lambda: not visitor.ended and "what no page sends" in caplog.text)
        time.sleep(2.0)
    said = [r.getMessage() for r in caplog.records]
    assert 1 <= len(said) <= 6 and all("what no page sends" in line for line in said), said
    assert "Traceback" not in capfd.readouterr().err


def test_commands_that_wait_have_a_bound() -> None:
    session = Session(make_env, FakePolicy(), policies)
    for _ in range(MOST_WAITING):
        session.send(SetCamera("first", OFF))
    with pytest.raises(UserError, match=f"at most {MOST_WAITING} commands"):
        session.send(SetCamera("first", BLACK))
    session.tick(0.0)
    session.send(Pause())


def test_what_waits_for_a_process_has_a_bound_too() -> None:
    process = SessionProcess(lambda policy: Session(make_env, policy or FakePolicy(), policies))
    for _ in range(MOST_WAITING):
        process.send(SetCamera("first", OFF))
    with pytest.raises(UserError, match=f"at most {MOST_WAITING} commands"):
        process.send(Pause())
    process.close()


def noisy(number: int) -> Condition:
    """A condition for each ``number``."""
    return Condition("all", (("first", Occlusion("noise", number / 10_000)),))


def test_conditions_that_were_seen_long_ago_are_forgotten() -> None:
    rates, spec = SuccessRates(), FakePolicy().spec
    for number in range(MOST_CONDITIONS + 10):
        rates.add(spec, noisy(number), {1: True})
    assert len(rates._live) == MOST_CONDITIONS
    assert rates.live(spec, noisy(9)).n == 0
    assert rates.live(spec, noisy(MOST_CONDITIONS)).n == 1


def test_requests_that_nobody_wants_any_more_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "MOST_REQUESTS", 5)
    monkeypatch.setattr(live.checkpoint, "is_folder", lambda name: False)
    monkeypatch.setattr(live.checkpoint, "load_policy", lambda name: FakePolicy())
    evaluator = Evaluator(1, make_workers=lambda *_: NoWorkers())  # type: ignore[arg-type, return-value]
    for visitor in range(3):
        evaluator.request(visitor, "toy", noisy(visitor))
    for number in range(20):
        evaluator.request("one", "toy", noisy(100 + number))
    assert len(evaluator._tables) <= 5 + 4
    assert set(evaluator._wanted.values()) <= set(evaluator._tables)
    evaluator.close()


class NoWorkers:
    """Processes that never have time."""

    count = 0
    generation = 0

    def close(self) -> None: ...


def test_a_schedule_has_a_bound() -> None:
    words = [f"first@{n}-{n + 1}" for n in range(0, 2 * MOST_FAILURES + 2, 2)]
    assert len(parse_schedule(words[:-1], ["first"])) == 2 * MOST_FAILURES
    with pytest.raises(UserError, match=f"at most {MOST_FAILURES} failures, found 201"):
        parse_schedule(words, ["first"])


def test_a_file_waits_for_the_one_before(server: viser.ViserServer) -> None:
    client = browser(server)
    sent: list[str] = []
    client.send_file_download = lambda name, content, **_: sent.append(name)
    download(client, "one.json", b"{}")
    part = FileTransferPart(None, "t", 0, b"{}")
    client._websock_connection.buffer.message_from_id[1] = part
    assert is_downloading(client)
    with pytest.raises(UserError, match="one file at a time"):
        download(client, "two.json", b"{}")
    assert sent == ["one.json"]


def test_a_folder_that_takes_no_files_is_said_on_the_page(server: viser.ViserServer) -> None:
    def start() -> None:
        raise PermissionError(13, "Permission denied", "runs/page")

    client = browser(server)
    guarded(client, start)
    assert client.notes == [("That did not work", "runs/page: Permission denied")]


def test_a_slow_button_has_one_press_at_work() -> None:
    going, pressed = threading.Event(), list[int]()

    def work(number: int) -> None:
        pressed.append(number)
        going.wait(10)

    async def press() -> None:
        callback = one_at_a_time(work)
        first = asyncio.create_task(callback(1))
        while not pressed:
            await asyncio.sleep(0.001)
        await asyncio.gather(*(callback(n) for n in range(2, 100)))
        going.set()
        await first
        await callback(100)

    asyncio.run(press())
    assert pressed == [1, 100]
