"""Frames from one process to another, each object that both have already sent once.

The problem: a frame holds pictures, which are new, and much that is not: the meshes of the scene
(0.19 MB for hammer), the environment's and the policy's facts, a point of the timeline for every
step so far. And a page finds out by identity whether the scene or the last
change is another one, so a copy is not enough: what is the same object here must be it there.

The idea: both ends keep a table of the objects that the last frame used. A frame names those by
their numbers, and brings those that are new with it:

    step 40   new: point 40                       frame: env 0, policy 1, bodies 2, points 3 ... 43
    step 41   new: point 41                       frame: env 0, policy 1, bodies 2, points 3 ... 44
    reset     new: point 0 of the next episode    frame: env 0, policy 1, bodies 2, point 45

Both ends forget what a frame did not use, so that the tables stay as small as a frame. The bytes
are pickle's, between processes that madviz itself has started; nothing from outside is read so.
"""

from __future__ import annotations

import io
import pickle
from typing import Any, NamedTuple

from madviz.analysis.foresight import Foresight, Happened
from madviz.session.frame import (
    Branch,
    Change,
    Frame,
    HandPaths,
    NoFrame,
    Outcome,
    Pair,
    TimelinePoint,
)
from madviz.types import Body, EnvSpec, Future, PolicySpec

_SHARED = (
    Branch,
    Change,
    EnvSpec,
    Foresight,
    Future,
    HandPaths,
    Happened,
    Outcome,
    Pair,
    PolicySpec,
    TimelinePoint,
)
"""Frozen, and the same object in many frames."""


class _Message(NamedTuple):
    """The message for one frame."""

    new: list[tuple[int, bytes]]
    """Objects that the other end does not have, by number; each may hold earlier ones."""
    frame: bytes


def _is_shared(thing: object) -> bool:
    if isinstance(thing, tuple) and thing and isinstance(thing[0], Body):
        return True
    return isinstance(thing, _SHARED)


class _Pickler(pickle.Pickler):
    """Writes ``root`` in full, and everything shared in it as a number."""

    def __init__(self, file: io.BytesIO, encoder: FrameEncoder, root: object) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._encoder = encoder
        self._root = root

    def persistent_id(self, obj: Any) -> int | None:
        if obj is self._root or not _is_shared(obj):
            return None
        return self._encoder.number(obj)


class FrameEncoder:
    """The sending end. Belongs to one thread."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[int, object]] = {}
        """By ``id``: the number, and the object itself, so that its ``id`` is not given again."""
        self._used: dict[int, tuple[int, object]] = {}
        self._new: list[tuple[int, bytes]] = []
        self._next = 0

    def encode(self, news: Frame | NoFrame) -> bytes:
        """The bytes of ``news``; every frame must reach the other end, in this order."""
        self._used = {}
        self._new = []
        message = _Message([], self._pickled(news))
        self._known = self._used
        return pickle.dumps(message._replace(new=self._new), pickle.HIGHEST_PROTOCOL)

    def number(self, thing: object) -> int:
        """The number of a shared object, which is written down first if it is new."""
        found = self._used.get(id(thing)) or self._known.get(id(thing))
        if found is None:
            data = self._pickled(thing)  # First, for what it holds needs its numbers before it.
            found = (self._next, thing)
            self._next += 1
            self._new.append((found[0], data))
        self._used[id(thing)] = found
        return found[0]

    def _pickled(self, root: object) -> bytes:
        file = io.BytesIO()
        _Pickler(file, self, root).dump(root)
        return file.getvalue()


class _Unpickler(pickle.Unpickler):
    """Reads what ``_Pickler`` wrote."""

    def __init__(self, data: bytes, decoder: FrameDecoder) -> None:
        super().__init__(io.BytesIO(data))
        self._decoder = decoder

    def persistent_load(self, pid: Any) -> object:
        return self._decoder.shared(pid)


class FrameDecoder:
    """The receiving end. Belongs to one thread."""

    def __init__(self) -> None:
        self._known: dict[int, object] = {}
        self._used: dict[int, object] = {}

    def decode(self, data: bytes) -> Frame | NoFrame:
        """The frame that the other end's encoder was given."""
        message: _Message = pickle.loads(data)
        self._used = {}
        for number, each in message.new:
            self._known[number] = _Unpickler(each, self).load()
        news = _Unpickler(message.frame, self).load()
        self._known = self._used
        return news

    def shared(self, number: int) -> object:
        """The object of that number."""
        self._used[number] = self._known[number]
        return self._used[number]
