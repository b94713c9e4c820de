"""Servers of policies that tests can break."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from madviz.wire.codec import Protocol, pack, unpack

Answer = Callable[[dict[str, Any], ServerConnection], Any]
"""From a look and the connection to the payload of the answer; None: nothing is sent."""
WIRING = {
    "task": '"toy/reach"',
    "size": "84",
    "state": '"state"',
    "masks": "true",
    "cameras": '{ first = "wrist", third_a = "front" }',
}


def wiring_file(folder: Path, **changed: str | None) -> Path:
    """A --wire file; a value of None is left out."""
    lines = {**WIRING, **changed}
    file = folder / "wire.toml"
    file.write_text("\n".join(f"{k} = {v}" for k, v in lines.items() if v is not None))
    return file


@contextmanager
def foreign_server(
    answer: Answer, protocol: Protocol = "vla-eval", says: dict[str, Any] | None = None
) -> Iterator[str]:
    """The address of a server that is not madviz's own. It says ``says`` of its policy, which may
    change meanwhile."""

    def talk(connection: ServerConnection) -> None:
        try:
            if protocol == "openpi":
                connection.send(pack({"robot": "toy", **(says or {})}, protocol))
            for data in connection:
                told = unpack(data)
                if protocol == "vla-eval":
                    _vla_eval(connection, told, answer, says or {})
                elif (payload := answer(told, connection)) is not None:
                    connection.send(pack(payload, protocol))
        except ConnectionClosed:
            pass

    server = serve(talk, "127.0.0.1", 0, compression=None, max_size=None)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
    finally:
        server.shutdown()
        thread.join(5)


def _vla_eval(
    connection: ServerConnection, told: dict[str, Any], answer: Answer, says: dict[str, Any]
) -> None:
    back = {"seq": told["seq"], "timestamp": 0.0}
    if told["type"] == "hello":
        connection.send(
            pack({"type": "hello", "payload": {"capabilities": {}, **says}, **back}, "vla-eval")
        )
    elif told["type"] == "observation":
        payload = answer(told["payload"], connection)
        if payload is not None:
            connection.send(pack({"type": "action", "payload": payload, **back}, "vla-eval"))


def towards_bright(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any]:
    """An action that depends on which pictures came, and on what is in them."""
    seen = {name: float(picture.mean()) / 255 for name, picture in look["images"].items()}
    return {"actions": np.array([seen.get("wrist", -0.5), seen.get("front", 0.5)], np.float32)}
