"""Pages without a browser: what is put on them, found and used as a visitor would."""

from __future__ import annotations

import asyncio
import inspect
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import viser

from madviz.app.access import Gate
from madviz.app.layout import Shared
from madviz.app.panels.policy import PolicyChoice
from madviz.app.server import App
from madviz.app.users import Limits, Users
from madviz.envs.registry import make_env
from madviz.session.live_session import LiveSession
from madviz.session.session import Session
from tests.fakes import policies


class Recorded:
    """The ``gui`` or ``scene`` of a server or a client, and all that was added to it."""

    def __init__(self, api: Any) -> None:
        self._api = api
        self.added: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        real = getattr(self._api, name)
        if not name.startswith("add_"):
            return real

        def add(*words: Any, **options: Any) -> Any:
            self.added.append(real(*words, **options))
            return self.added[-1]

        return add

    def of(self, kind: str) -> list[Any]:
        """What was added of a kind, for example ``GuiUplotHandle``."""
        return [handle for handle in self.added if type(handle).__name__ == kind]

    def find(self, name: str, place: int = 0) -> Any:
        """A widget by its label or a node by its name; of several, the one at ``place``."""
        found = (getattr(one, "label", None) or getattr(one, "name", None) for one in self.added)
        return [one for one, has in zip(self.added, found, strict=True) if has == name][place]

    @property
    def present(self) -> list[Any]:
        """What was added and not removed again."""
        return [handle for handle in self.added if not handle._impl.removed]

    @property
    def html(self) -> str:
        """All text that is on it."""
        texts = (one for one in self.present if type(one).__name__ == "GuiHtmlHandle")
        return "\n".join(handle.content for handle in texts)


def recorded(api: Any) -> Any:
    """In place of ``api``, what also knows all that was added to it; see ``Recorded``."""
    return Recorded(api)


class Wire:
    """In place of viser's connection of a page: what is sent goes nowhere at once."""

    def __init__(self) -> None:
        self.buffer = SimpleNamespace(buffer_lock=threading.Lock(), message_from_id={})

    def queue_message(self, message: Any) -> None: ...

    def get_message_buffer(self) -> Any:
        return self.buffer


def browser(server: viser.ViserServer, number: int = 1, **more: Any) -> Any:
    """A client that nobody sees: it draws into the server's own widgets, and keeps its ``notes``
    and what was registered to follow its ``camera``."""
    notes: list[tuple[str, str]] = []
    followers: list[Any] = []
    camera = SimpleNamespace(
        image_width=1280,
        image_height=800,
        position=np.zeros(3),
        on_update=lambda callback: followers.append(callback) or callback,
        _state=SimpleNamespace(camera_cb=followers),
    )
    client = SimpleNamespace(
        client_id=number,
        gui=recorded(server.gui),
        scene=recorded(server.scene),
        atomic=server.atomic,
        flush=server.flush,
        camera=camera,
        followers=followers,
        notes=notes,
        add_notification=lambda title, body, **_: notes.append((title, body)),
        _websock_connection=Wire(),
    )
    vars(client).update(more)
    return client


def use(handle: Any, value: Any = None, client: Any = None) -> list[tuple[str, str]]:
    """A visitor presses a button, or gives a widget a ``value``. Returns the notes they get."""
    notes: list[tuple[str, str]] = []
    somebody: Any = SimpleNamespace(
        client_id=1,
        add_notification=lambda title, body, **_: notes.append((title, body)),
        _websock_connection=Wire(),
    )
    if value is not None:
        handle._impl.value = value
    _hear(handle._impl.update_cb, viser.GuiEvent(client or somebody, 1, handle))
    return notes


def drag(handle: Any, phase: str) -> None:
    """A visitor holds the arrows of a node, which stand where the test has put them."""
    event = SimpleNamespace(client=object(), phase=phase, target=handle)
    _hear(handle._impl_aux.update_cb, event)


def _hear(callbacks: list[Any], event: Any) -> None:
    for callback in list(callbacks):
        answer = callback(event)
        if inspect.iscoroutine(answer):
            asyncio.run(answer)


def await_that(happened: Callable[[], object], patience: float = 20.0) -> None:
    """Waits until ``happened`` is true; fails after ``patience`` seconds."""
    deadline = time.monotonic() + patience
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)


def until(happened: Callable[[], object], patience: float = 60.0) -> None:
    """``await_that`` for visitors of a page, who come and go beside other tests."""
    await_that(happened, patience)


def choices_of(*names: str) -> list[PolicyChoice]:
    """Policies of ``tests.fakes`` as a page offers them."""
    return [PolicyChoice(name, name) for name in names]


def seats(users: Users) -> tuple[int, int, int]:
    """Pages with the controls of a simulation, pages that watch one, browsers without a place."""
    with users._lock:
        owners = sum(visit.owner for visit in users._visits.values())
        return owners, len(users._visits) - owners, len(users._queue)


def sessions_shown(users: Users) -> dict[int, LiveSession]:
    """By the number of its browser, the session that each page shows."""
    with users._lock:
        return {number: visit.session for number, visit in users._visits.items()}


def fake_app(
    *names: str, speed: float = 10.0, gate: Gate | None = None, limits: Limits | None = None
) -> App:
    """A page on the toy task with the fake policies of these ``names``, on a free port."""

    def new_session() -> Session:
        return Session(make_env, policies(names[0]), policies, speed=speed)

    return App(new_session, Shared(choices_of(*names)), limits, gate=gate)
