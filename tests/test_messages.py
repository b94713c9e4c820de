"""Of all the messages that viser knows, only those that the page sends reach it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any, Union, get_args, get_origin

import msgspec.msgpack
import pytest
import viser
from viser._messages import Message
from viser.infra._messages import get_type_hints_cached, wire_field_names
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from benchmarks.visitor import Visitor
from madviz.app.access import Gate
from madviz.app.connection import TAKEN
from madviz.app.server import App
from tests.pages import fake_app, until

KINDS: dict[str, type[Message]] = {kind.__name__: kind for kind in Message.get_subclasses()}
LET_GO = 1002
"""The code with which a connection is closed after a message that no page sends."""
REFUSED = {
    "ShareUrlRequest",
    "ShareUrlDisconnect",
    "FileTransferStartUpload",
    "FileTransferPart",
    "GuiButtonHoldMessage",
    "GuiFormSubmitMessage",
    "GuiFormDirtyMessage",
    "SceneNodeDragMessage",
    "ScenePointerMessage",
}
"""What viser would act upon and the page does not send."""


def sample(hint: Any) -> Any:
    """A value that viser takes for one of the type ``hint``."""
    if get_origin(hint) is tuple:
        return [sample(each) for each in get_args(hint) if each is not ...]
    if get_origin(hint) is Union:
        return sample(get_args(hint)[0])
    if get_origin(hint) is dict:
        return {"value": 1}
    return {float: 0.5, int: 1, bool: True, str: "x", bytes: b"x"}.get(hint)


def written(kind: type[Message]) -> bytes:
    """A message of that kind, as it comes over a websocket."""
    hints = get_type_hints_cached(kind)
    fields = {name: sample(hints[name]) for name in wire_field_names(kind)}
    return msgspec.msgpack.encode({**fields, "type": kind.__name__})


@pytest.fixture(scope="module")
def reached() -> Iterator[tuple[viser.ViserServer, list[str]]]:
    """A server behind a gate that does nothing but to note the kinds of messages that reach it."""
    with Gate().guarding():
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    come: list[str] = []
    inner = server._websock_server
    inner._incoming_handlers.clear()
    inner._client_connect_cb.clear()
    inner._client_disconnect_cb.clear()
    for kind in KINDS.values():
        inner.register_handler(kind, lambda _, message: come.append(type(message).__name__))
    yield server, come
    server.stop()


def closed_with(connection: Any) -> int | None:
    try:
        while True:
            connection.recv(timeout=10)
    except ConnectionClosed as closed:
        return closed.rcvd.code if closed.rcvd else None


@pytest.mark.parametrize("name", KINDS)
def test_only_what_the_page_sends_reaches_viser(reached, name: str):
    server, come = reached
    message = written(KINDS[name])
    assert type(Message.deserialize(message)) is KINDS[name]  # viser itself would take it.
    spoken = [Subprotocol(f"viser-v{viser.__version__}")]
    come.clear()
    with connect(f"ws://127.0.0.1:{server.get_port()}", subprotocols=spoken) as connection:
        connection.send(message)
        if name in TAKEN:
            until(lambda: come == [name])
        else:
            assert closed_with(connection) == LET_GO and come == []


def test_every_kind_that_the_page_sends_is_one_that_viser_knows():
    assert set(KINDS) >= TAKEN


def test_what_viser_acts_upon_is_known_here(shown: App):
    """A new viser may act upon more: then somebody decides whether the page needs it."""
    with Visitor(shown.url):
        until(shown.server.get_clients)
        (client,) = shown.server.get_clients().values()
        both = (shown.server._websock_server, client._websock_connection)
        acted = {kind.__name__ for each in both for kind in each._incoming_handlers}
    assert acted == TAKEN | REFUSED


@pytest.fixture(scope="module")
def shown() -> Iterator[App]:
    app = fake_app("toy-mad", gate=Gate(present="mine"), speed=20.0)
    yield app
    app.stop()


def test_a_watcher_cannot_ask_for_a_public_address(shown: App, monkeypatch, caplog):
    asked: list[str] = []
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(shown.server, name, lambda name=name: asked.append(name))
    with Visitor(shown.url) as other:
        until(lambda: other.steps)
        for name in ("ShareUrlRequest", "ShareUrlDisconnect"):
            with caplog.at_level(logging.WARNING), Visitor(shown.url) as watcher:
                watcher.send_raw(written(KINDS[name]))
                watcher.send_raw(written(KINDS[name]))
                until(lambda watcher=watcher: watcher.ended, 10.0)
            (line,) = [r.getMessage() for r in caplog.records if name in r.getMessage()]
            assert line.startswith("let go of a connection") and "\n" not in line
        seen = len(other.steps)
        until(lambda: len(other.steps) > seen + 3)
        assert not other.ended
    assert asked == []


def test_nobody_uploads_what_nobody_asked_for(shown: App):
    with Visitor(shown.url) as watcher:
        until(lambda: watcher.controls)
        (client,) = shown.server.get_clients().values()
        mine = next(iter(watcher.controls))
        start = {"source_component_uuid": mine, "transfer_uuid": "t", "filename": "f"}
        start |= {"mime_type": "", "part_count": 1000, "size_bytes": 10**9}
        watcher.send_raw(msgspec.msgpack.encode({"type": "FileTransferStartUpload", **start}))
        until(lambda: watcher.ended, 10.0)
        assert client.gui._current_file_upload_states == {}
        assert shown.server.gui._current_file_upload_states == {}
