"""Stores for the replay buffer's frames: as they are, or packed without loss.

Frames of one task look alike: the table stays where it is and the arm moves a little. So a packed
frame is compressed by zstd *against a few pictures* of the same stream, out of the same 1,024
time steps, which serve as a dictionary; what does not differ from them costs next to nothing. Every
frame is still unpacked on its own, and a transition needs only the four it shows per stream:

    time steps  1024 ... 2047               2048 ... 3071          3072 ...
    stored as   pack: 8 pictures, frames    pack                   plain, until there are 1,024

Subtracting each frame from the one before would pack tighter (10 against 11.5 kB a time step, three
streams of Meta-World's hammer), but a frame could then only be reached through others before it.
Plain frames take 63.5 kB. Unpacking takes 15 to 25 microseconds of one core a frame.

Packs never change, and are dropped whole when the ring has gone past them. Frames in a GPU's memory
are not packed: ``buffer_device.py``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
import zstandard
from torch import Tensor

from madviz.observation.streams import IMAGE_SIZE
from madviz.types import Array

TOGETHER = 1024
"""Time steps in a pack; the newest ones, up to as many, are stored plain."""
PICTURES = 8
"""Frames that serve as a pack's dictionary."""
LEVEL = 3
"""The level of zstd: packing takes 0.1 ms a frame, once; unpacking takes the same at all levels."""
EXPECTED_SHARE = 0.375
"""Share of a plain frame's bytes, said in advance; measured were 0.18 (hammer) and 0.21
(push-cube)."""


class FrameStore:
    """Frames by stream and time step; steps are numbered on and on, the oldest are dropped."""

    def __init__(self, channels: Sequence[int]) -> None:
        """``channels`` of every stream's frames: 3 for colour, 1 for depth."""
        self._channels = channels

    def write(self, number: int, frames: Sequence[Array]) -> None:
        """The frames (H, W, C) of all streams at the time step ``number``, the last one plus 1."""
        raise NotImplementedError

    def read(self, stream: int, numbers: Iterable[int]) -> dict[int, Array]:
        """Frames (H, W, C) by time step; not to be written to, and used before a ``write``."""
        raise NotImplementedError

    def stacks(self, histories: Sequence[Array]) -> list[Tensor]:
        """For each (B, F) of time steps, the (B, V, 3 F, H, W) uint8 they show, channels last in
        memory: what the encoder wants. A frame that several stacks show is fetched once. They are
        put together on the host here, and by ``DeviceFrames`` on its device."""
        count = len(self._channels)
        size = IMAGE_SIZE
        stacks = [
            np.empty((len(history), count, size, size, 3 * history.shape[1]), np.uint8)
            for history in histories
        ]
        needed = np.unique(np.concatenate(histories)).tolist()
        for v, channels in enumerate(self._channels):
            frames = self.read(v, needed)
            repeat = 3 // channels
            for out, history in zip(stacks, histories, strict=True):
                for views, numbers in zip(out, history.tolist(), strict=True):
                    cv2.merge([frames[n] for n in numbers for _ in range(repeat)], views[v])
        return [torch.from_numpy(out).permute(0, 1, 4, 2, 3) for out in stacks]


class PlainFrames(FrameStore):
    """Every frame as it is, in memory or in files."""

    def __init__(self, rows: int, channels: Sequence[int], files: Sequence[Path] = ()) -> None:
        """Room for ``rows`` time steps; in a file for each stream if there are ``files``. Raises
        OSError for a disk without the room."""
        super().__init__(channels)
        shapes = [(rows, IMAGE_SIZE, IMAGE_SIZE, count) for count in channels]
        self._rows = rows
        self._arrays: list[Array] = (
            [_reserved(file, shape) for file, shape in zip(files, shapes, strict=True)]
            if files
            else [np.empty(shape, np.uint8) for shape in shapes]
        )

    def write(self, number: int, frames: Sequence[Array]) -> None:
        for array, frame in zip(self._arrays, frames, strict=True):
            array[number % self._rows] = frame

    def read(self, stream: int, numbers: Iterable[int]) -> dict[int, Array]:
        array = self._arrays[stream]
        return {number: array[number % self._rows] for number in numbers}


def _reserved(file: Path, shape: tuple[int, ...]) -> Array:
    """A new file as an array. Its room is taken now: a mapped file that finds a full disk later
    would end the process without a word."""
    with file.open("wb") as new:
        os.posix_fallocate(new.fileno(), 0, math.prod(shape))
    return np.memmap(file, np.uint8, "r+", shape=shape)


class Pack:
    """Frames of one stream, each compressed on its own against the same few pictures."""

    KEYS = ("pictures", "data", "ends", "shape")

    def __init__(self, pictures: bytes, data: bytes, ends: Array, shape: tuple[int, ...]) -> None:
        """``ends`` (n,) says where in ``data`` each frame stops; ``shape`` is (H, W, C)."""
        self._dictionary = _dictionary(pictures)
        self._data = memoryview(data)
        self._ends = ends
        self._shape = shape

    @classmethod
    def of(cls, frames: Array) -> Pack:
        """Packs ``frames`` (n, H, W, C)."""
        chosen = np.linspace(0, len(frames) - 1, PICTURES + 2).round().astype(int)[1:-1]
        pictures = frames[np.unique(chosen)].tobytes()
        packer = zstandard.ZstdCompressor(LEVEL, dict_data=_dictionary(pictures))
        pieces = [packer.compress(frame.tobytes()) for frame in frames]
        ends = np.cumsum([len(piece) for piece in pieces], dtype=np.int64)
        return cls(pictures, b"".join(pieces), ends, frames.shape[1:])

    def frames(self, places: Iterable[int]) -> list[Array]:
        """The frames (H, W, C) at ``places`` below n."""
        unpacker = zstandard.ZstdDecompressor(dict_data=self._dictionary)
        unpacked = []
        for place in places:
            start = int(self._ends[place - 1]) if place else 0
            raw = unpacker.decompress(self._data[start : int(self._ends[place])])
            unpacked.append(np.frombuffer(raw, np.uint8).reshape(self._shape))
        return unpacked

    def __len__(self) -> int:
        return len(self._ends)

    @property
    def nbytes(self) -> int:
        return len(self._data) + self._ends.nbytes + len(self._dictionary)

    def arrays(self) -> dict[str, Array]:
        """The arrays from which ``from_arrays`` makes the same pack; for files."""
        return {
            "pictures": np.frombuffer(self._dictionary.as_bytes(), np.uint8),
            "data": np.frombuffer(self._data, np.uint8),
            "ends": self._ends,
            "shape": np.array(self._shape),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, Array]) -> Pack:
        shape = tuple(arrays["shape"].tolist())
        return cls(arrays["pictures"].tobytes(), arrays["data"].tobytes(), arrays["ends"], shape)


class PackedFrames(FrameStore):
    """Packs of ``TOGETHER`` time steps, and the newest time steps plain."""

    def __init__(self, rows: int, channels: Sequence[int]) -> None:
        """Remembers ``rows`` time steps, and up to two packs more."""
        super().__init__(channels)
        self._rows = rows
        self._packs: dict[int, list[Pack]] = {}
        size = (TOGETHER, IMAGE_SIZE, IMAGE_SIZE)
        self._open = [np.zeros((*size, count), np.uint8) for count in channels]

    def write(self, number: int, frames: Sequence[Array]) -> None:
        block, place = divmod(number, TOGETHER)
        for array, frame in zip(self._open, frames, strict=True):
            array[place] = frame
        if place == TOGETHER - 1:
            self._packs[block] = [Pack.of(array) for array in self._open]
            first = (number + 1 - self._rows) // TOGETHER
            for old in [each for each in self._packs if each < first]:
                del self._packs[old]

    def read(self, stream: int, numbers: Iterable[int]) -> dict[int, Array]:
        blocks: dict[int, list[int]] = {}
        for number in numbers:
            blocks.setdefault(number // TOGETHER, []).append(number)
        found: dict[int, Array] = {}
        for block, wanted in blocks.items():
            places = [number % TOGETHER for number in wanted]
            if block in self._packs:
                frames = self._packs[block][stream].frames(places)
            else:
                frames = [self._open[stream][place] for place in places]
            found.update(zip(wanted, frames, strict=True))
        return found

    @property
    def bytes_packed(self) -> tuple[int, int]:
        """Bytes of all packs, and the time steps in them."""
        packs = self._packs.values()
        return sum(p.nbytes for pack in packs for p in pack), sum(len(pack[0]) for pack in packs)


def _dictionary(pictures: bytes) -> zstandard.ZstdCompressionDict:
    return zstandard.ZstdCompressionDict(pictures, dict_type=zstandard.DICT_TYPE_RAWCONTENT)
