"""Decoded pictures on disk: a file for each episode and size, mapped into memory when it is used.

A film is slow to decode and cannot be read at random, so an episode is decoded once. Its file
appears when it is whole. The name says what it was made from: changed films make a new file.
`madviz doctor --clear-recordings` removes all.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from madviz.errors import UserError
from madviz.recorded.films import letterboxed
from madviz.recorded.storage import recordings_cache
from madviz.system.files import replacing
from madviz.types import Array


class CacheError(UserError):
    """The cache cannot be written, which is no fault of an episode."""


def packed(
    name: str,
    sources: Iterable[Path],
    facts: object,
    shape: tuple[int, int, int, int, int],
    pictures: Iterator[tuple[int, int, Array]],
) -> Array:
    """(T, V, size, size, 3) uint8, a read-only map of the file for ``name``, which is made if it is
    not there: ``pictures`` are (step, camera, picture (H, W, 3)) in any order. ``sources`` and
    ``facts`` are what they are made from. Raises CacheError if it cannot be written, and
    UserError for a source that is gone."""
    digest = hashlib.sha256(repr((facts, shape)).encode())
    for path in sources:
        try:
            found = path.stat()
        except OSError as error:
            raise UserError(
                f"{path}: expected a file of the recordings, found: {error.strerror}; put it back"
            ) from error
        digest.update(f"{path}\0{found.st_size}\0{found.st_mtime_ns}\0".encode())
    file = recordings_cache() / f"{name}-{shape[2]}-{digest.hexdigest()[:32]}.npy"
    with suppress(OSError, ValueError):
        mapped = np.load(file, mmap_mode="r")
        if mapped.shape == shape and mapped.dtype == np.uint8:
            return mapped
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as part:
            _write(part, shape, pictures)
        return np.load(file, mmap_mode="r")
    except OSError as error:
        raise CacheError(
            f"{file.parent}: expected room for decoded pictures, found: {error.strerror}; make "
            "room there, or set XDG_CACHE_HOME to another place"
        ) from error


def _write(
    part: Path, shape: tuple[int, int, int, int, int], pictures: Iterator[tuple[int, int, Array]]
) -> None:
    """Written in place and not mapped: on a full disk, a map would end the process."""
    facts = {"descr": "|u1", "fortran_order": False, "shape": shape}
    size = shape[2]
    with part.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, facts)
        begin = file.tell()
        for step, camera, picture in pictures:
            file.seek(begin + (step * shape[1] + camera) * size * size * 3)
            file.write(letterboxed(picture, size).tobytes())  # Whole, or an error.
