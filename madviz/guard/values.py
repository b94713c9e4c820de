"""The fitted values of a guard: guard.json beside a policy, 20 kB at most.

They say for each stream how its pictures usually are, in the numbers of ``pictures.py``, and how
its cells change when the robot moves. They are no part of the policy: its digest stays the same.
"""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path

import msgspec
import numpy as np

from madviz.errors import UserError
from madviz.guard.pictures import CELLS
from madviz.system.files import pretty, read_json, write_bytes
from madviz.system.typed import typed
from madviz.types import Array

FILE = "guard.json"
SCHEMA = 2
LARGEST = 20_000
"""Bytes of the file."""


class StreamValues(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the pictures of one stream usually are."""

    spread: float
    """The smallest in the episodes that were fitted."""
    dark: int
    """The largest; so is ``rough``."""
    rough: int
    edges: int
    """The smallest."""
    reach: tuple[float, ...]
    """By number of the robot (``GuardValues.state``), the largest change between two pictures that
    were the same: so a joint may tremble, and a speed may change, where a hand may not move."""
    numbers: tuple[int, ...] = ()
    """Those of the robot's numbers (places in ``GuardValues.state``) whose change can be read from
    a change of the cells; none: lateness cannot be detected."""
    scales: tuple[float, ...] = ()
    """The size of a weight of 1, by number."""
    weights: str = ""
    """(441, numbers) int8, in base64: from a change of the cells to a change of the numbers."""

    def matrix(self) -> Array:
        """(441, numbers) float64: a change of the cells times this is a change of the numbers."""
        raw = np.frombuffer(base64.b64decode(self.weights), np.int8)
        return raw.reshape(CELLS * CELLS, len(self.numbers)) * np.array(self.scales)


class GuardValues(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    schema: int
    size: tuple[int, int]
    """Rows and columns of the pictures."""
    state: tuple[int, ...]
    """The places in the state (S,) that say where the robot is."""
    unit: tuple[float, ...]
    """The standard deviation of each in the episodes that were fitted. Movements are measured in
    these units."""
    streams: dict[str, StreamValues]
    seeds: tuple[int, ...] = ()
    """The episodes that were fitted."""

    @property
    def digest(self) -> str:
        """SHA-256 of the values."""
        text = json.dumps(msgspec.to_builtins(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def encoded_weights(matrix: Array) -> tuple[tuple[float, ...], str]:
    """The scales and the weights that ``StreamValues`` holds, of ``matrix`` (441, numbers)."""
    scales = np.maximum(np.abs(matrix).max(0) / 127, 1e-12)
    scales = np.array([float(f"{scale:.6g}") for scale in scales])
    raw = np.clip(np.round(matrix / scales), -127, 127).astype(np.int8)
    return tuple(scales.tolist()), base64.b64encode(raw.tobytes()).decode()


def read_values(file: Path, fit: str) -> GuardValues:
    """The values in ``file``. ``fit`` is the command that makes them. Raises UserError, which names
    it, for a file that is not there or holds something else."""
    if not file.is_file():
        raise UserError(f"{file}: expected fitted values of the guard, found none; run `{fit}`")
    values = typed(read_json(file), GuardValues, file, f"run `{fit}`")
    for name, stream in values.streams.items():
        try:
            stream.matrix()
        except ValueError as error:
            raise UserError(
                f"{file}: expected {CELLS * CELLS} weights for each number of {name}, found "
                f"others; run `{fit}`"
            ) from error
    if values.schema != SCHEMA or not _fits(values):
        raise UserError(f"{file}: expected values of this version, found others; run `{fit}`")
    return values


def _fits(values: GuardValues) -> bool:
    """The lengths agree, the places exist, and no unit is 0."""
    count = len(values.state)
    places = count > 0 and min(values.state) >= 0 and len(values.unit) == count
    return (
        places
        and min(values.unit) > 0
        and all(
            len(stream.reach) == count
            and len(stream.scales) == len(stream.numbers)
            and all(0 <= number < count for number in stream.numbers)
            for stream in values.streams.values()
        )
    )


def write_values(file: Path, values: GuardValues) -> None:
    """Writes guard.json. Raises UserError where it would be too large."""
    content = pretty(msgspec.to_builtins(values)).encode()
    if len(content) > LARGEST:
        raise UserError(
            f"{file}: expected {LARGEST} bytes or fewer, found {len(content)}; guard fewer streams"
        )
    write_bytes(file, content)
