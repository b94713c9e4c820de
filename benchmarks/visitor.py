"""A visitor without a browser: a websocket client of viser's protocol, for measuring.

A headless browser takes a core and 300 MB, so a few of them would be measured instead of the
server. This one costs next to nothing: it decodes what the server sends, remembers which controls
it was given, counts the simulator steps whose pictures came, and can press what is there.

    server ──► [8 bytes: length][8 bytes: packed length][zstd: messages as msgpack][arrays]
    visitor ─► msgpack of one message, for example {"type": "GuiUpdateMessage", "uuid": ..., ...}
"""

from __future__ import annotations

import random
import re
import threading
import time
from importlib.metadata import version
from typing import Any

import msgspec.msgpack
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from madviz.errors import UserError

LARGEST = 2**28
"""Bytes of one message that are taken from the server."""
_STEP = re.compile(r'class="mv-feed"[^>]*data-step="([^"]*)"')


class Visitor:
    """One connection; ``close`` ends it and its thread. A context manager, too."""

    def __init__(self, url: str, cookie: str = "", width: int = 1280) -> None:
        """``url`` as for a browser, with its token if one is needed. Raises UserError where nothing
        answers or this visitor is refused."""
        address = url.replace("http://", "ws://", 1)
        headers = {"Cookie": cookie} if cookie else {}
        try:
            self._socket: ClientConnection = connect(
                address,
                subprotocols=[Subprotocol(f"viser-v{version('viser')}")],
                additional_headers=headers,
                max_size=LARGEST,
                compression=None,
                open_timeout=60,
            )
        except Exception as error:
            raise UserError(f"no page to visit at {url} ({error})") from error
        self.controls: dict[str, dict[str, Any]] = {}
        """By uuid: what kind of control the page has, its value and properties."""
        self.texts: dict[str, str] = {}
        """By uuid: the HTML on the page."""
        self.steps: list[tuple[float, str]] = []
        """When the picture of which step came."""
        self.messages = 0
        self._unpack = zstandard.ZstdDecompressor()
        self._thread = threading.Thread(target=self._listen, name="visitor", daemon=True)
        self._thread.start()
        self.send(
            "ViewerCameraMessage",
            wxyz=(1.0, 0.0, 0.0, 0.0),
            position=(1.0, 1.0, 1.0),
            fov=1.0,
            near=0.01,
            far=100.0,
            image_height=800,
            image_width=width,
            look_at=(0.0, 0.0, 0.0),
            up_direction=(0.0, 0.0, 1.0),
        )

    def __enter__(self) -> Visitor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def ended(self) -> bool:
        """Whether the server has ended the connection."""
        return not self._thread.is_alive()

    def send(self, kind: str, **fields: Any) -> None:
        """One message of viser's, as a page would send it: its class's name and its fields."""
        self.send_raw(msgspec.msgpack.encode({"type": kind, **fields}))

    def send_raw(self, data: bytes | str) -> None:
        """Anything at all."""
        try:
            self._socket.send(data)
        except ConnectionClosed:
            return

    def set(self, uuid: str, value: Any, prop: str = "value") -> None:
        """Gives a control a value; for a row of buttons: presses the one of that name."""
        self.send("GuiUpdateMessage", uuid=uuid, updates={prop: value})

    def find(self, label: str, kind: str = "") -> list[str]:
        """Controls of that label, in the order in which they came."""
        return [
            uuid
            for uuid, control in list(self.controls.items())
            if control["props"].get("label") == label and kind in control["type"]
        ]

    def toggle(self, rng: random.Random) -> bool:
        """Touches a row of buttons, or one of the first three sliders, at random; whether there was
        something to touch."""
        usable = [
            (uuid, control)
            for uuid, control in list(self.controls.items())
            if control["props"].get("visible", True) and not control["props"].get("disabled")
        ]
        rows = [(u, c) for u, c in usable if "ButtonGroup" in c["type"]]
        sliders = [(u, c) for u, c in usable if "GuiSlider" in c["type"]]
        if not rows:
            return False
        uuid, control = rng.choice(rows + sliders[:3])
        props = control["props"]
        if "options" in props:
            self.set(uuid, rng.choice(props["options"]))
        else:
            self.set(uuid, rng.uniform(props["min"], props["max"]))
        return True

    def shown(self, text: str) -> bool:
        """Whether the page says ``text`` somewhere."""
        return any(text in html for html in list(self.texts.values()))

    def updates_per_s(self, seconds: float) -> float:
        """Distinct simulator steps whose pictures arrive, a second, from now on."""
        self.steps.clear()
        start = time.monotonic()
        time.sleep(seconds)
        return len({step for _, step in list(self.steps)}) / (time.monotonic() - start)

    def close(self) -> None:
        self._socket.close()
        self._thread.join(10.0)

    def _listen(self) -> None:
        try:
            for data in self._socket:
                if isinstance(data, bytes):
                    self._take(data)
        except ConnectionClosed:
            return

    def _take(self, data: bytes) -> None:
        size = int.from_bytes(data[8:16], "little")
        inner = msgspec.msgpack.decode(self._unpack.decompress(data[16 : 16 + size]))
        for message in inner["messages"]:
            self.messages += 1
            kind = message["type"]
            uuid = message.get("uuid", "")
            if kind == "GuiRemoveMessage":
                self.controls.pop(uuid, None)
                self.texts.pop(uuid, None)
            elif kind == "GuiUpdateMessage":
                self._read(uuid, message["updates"])
                self._change(uuid, dict(message["updates"]))
            elif "container_uuid" in message and "props" in message:
                self._read(uuid, message["props"])
                if "value" in message:
                    self.controls[uuid] = message

    def _change(self, uuid: str, updates: dict[str, Any]) -> None:
        """A control's new value and properties."""
        control = self.controls.get(uuid)
        if control is None:
            return
        if "value" in updates:
            control["value"] = updates.pop("value")
        control["props"].update(updates)

    def _read(self, uuid: str, props: dict[str, Any]) -> None:
        html = props.get("content")
        if not isinstance(html, str):
            return
        self.texts[uuid] = html
        found = _STEP.search(html)
        if found:
            self.steps.append((time.monotonic(), found.group(1)))
