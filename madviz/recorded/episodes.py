"""Where each episode of a dataset lies, and which are whole."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from madviz.errors import UserError
from madviz.recorded.description import Description, inside
from madviz.recorded.films import check_film
from madviz.recorded.tables import column, read_rows, rows_of
from madviz.system.typed import typed
from madviz.types import Array

LONGEST = 100_000
"""Steps of an episode."""
MOST = 100_000
"""Episodes of a dataset."""
_KEYS: tuple[str, ...] = ("episode_index", "length", "tasks", "data/chunk_index", "data/file_index")
_SPARE_ROWS = 100_000
"""Rows that a table may hold beyond those of its episodes: a recording may have been stopped."""


@dataclass(frozen=True)
class RecordedEpisode:
    """An episode that is whole."""

    index: int
    """Its number in the dataset."""
    length: int
    """Steps."""
    task: str
    """The task in words."""


@dataclass(frozen=True)
class Location:
    """Where an episode lies."""

    data: Path
    first: int
    """Its first row there."""
    steps: int
    films: dict[str, tuple[Path, float]]
    """By column: the film, and the second at which the episode begins."""


class _Row(msgspec.Struct, rename=lambda name: name.replace("_of_", "/")):
    episode_index: int
    length: int
    data_of_chunk_index: int
    data_of_file_index: int
    tasks: list[str] = []


def find_episodes(
    description: Description,
) -> tuple[tuple[RecordedEpisode, ...], dict[int, Location], tuple[str, ...]]:
    """The whole episodes, the location of each by index, and one line for each that is not whole.
    Raises UserError for a dataset without a table of episodes, or with paths that lead out."""
    rows = _rows(description)
    files: dict[Path, list[_Row]] = defaultdict(list)
    for row, _ in rows:
        path = description.data_file(row.data_of_chunk_index, row.data_of_file_index)
        files[path].append(row)
    first: dict[int, int] = {}
    faults: dict[int, str] = {}
    for path, held in files.items():
        _find_rows(description, path, held, first, faults)
    locations: dict[int, Location] = {}
    checked = lru_cache(maxsize=None)(check_film)
    for row, extra in rows:
        index = row.episode_index
        films = _films(description, row, extra)
        if index not in faults:
            faults[index] = _film_fault(description, films, checked)
        if not faults[index]:
            data = description.data_file(row.data_of_chunk_index, row.data_of_file_index)
            starts = {key: (path, start) for key, (path, start, _) in films.items()}
            locations[index] = Location(data, first[index], row.length, starts)
    whole = tuple(
        RecordedEpisode(row.episode_index, row.length, " / ".join(row.tasks))
        for row, _ in rows
        if row.episode_index in locations
    )
    lines = [f"episode {index}: {fault}" for index, fault in faults.items() if fault]
    absent = sorted(set(range(min(description.total_episodes, MOST))) - set(faults))
    if absent:
        some = ", ".join(map(str, absent[:10]))
        lines.append(f"episode {some}: expected in meta/episodes, found none")
    return whole, locations, tuple(lines)


def numbers_of(description: Description, location: Location) -> tuple[Array, Array]:
    """States (T, S) and actions (T, A), float32."""
    keys = ["observation.state", "action"]
    batches = list(read_rows(location.data, keys, location.first, location.steps))
    states = column(batches, keys[0], location.data, len(description.state_names))
    actions = column(batches, keys[1], location.data, len(description.action_names))
    return states.astype(np.float32), actions.astype(np.float32)


def _rows(description: Description) -> list[tuple[_Row, dict[str, Any]]]:
    """A row for each episode, in order; beside it, the columns that say where films are."""
    folder = description.root / "meta" / "episodes"
    paths = sorted(folder.glob("*/*.parquet"))
    if not paths:
        raise UserError(f"{folder}: expected tables of episodes, found none; restore them")
    keys = list(_KEYS)
    for camera in description.cameras:
        if camera.kind == "video":
            ends = ("chunk_index", "file_index", "from_timestamp")
            keys += [f"videos/{camera.key}/{end}" for end in ends]
    rows: list[tuple[_Row, dict[str, Any]]] = []
    for path in paths:
        inside(description.root, str(path.relative_to(description.root)))
        if rows_of(path) > MOST:
            raise UserError(f"{path}: expected at most {MOST} episodes, found {rows_of(path)}")
        for batch in read_rows(path, keys):
            for value in batch.to_pylist():
                row = typed(value, _Row, path, "restore the file")
                if not 0 < row.length <= LONGEST:
                    raise UserError(
                        f"{path}: expected 1 to {LONGEST} steps in episode {row.episode_index}, "
                        f"found {row.length}"
                    )
                rows.append((row, value))
    rows.sort(key=lambda each: each[0].episode_index)
    indices = [row.episode_index for row, _ in rows]
    if len(set(indices)) < len(indices) or (indices and indices[0] < 0):
        raise UserError(f"{folder}: expected every episode once, found {indices[:10]}")
    return rows


def _find_rows(
    description: Description,
    path: Path,
    held: list[_Row],
    first: dict[int, int],
    faults: dict[int, str],
) -> None:
    """Fills in the first row of each episode that ``path`` should hold, or its fault."""
    try:
        said = sum(row.length for row in held)
        if rows_of(path) > 2 * said + _SPARE_ROWS:
            raise UserError(f"{path}: expected {said} rows, found {rows_of(path)}")
        facts = _checked_columns(description, path)
    except UserError as error:
        faults.update({row.episode_index: str(error) for row in held})
        return
    for row in held:
        where = np.flatnonzero(facts.episode == row.episode_index)
        if fault := _row_fault(facts, where, row.length, description.fps):
            faults[row.episode_index] = fault
        else:
            first[row.episode_index] = int(where[0])


@dataclass(frozen=True)
class _Facts:
    """A number for each row of a table."""

    episode: Array
    frame: Array
    timestamp: Array
    finite: Array
    """Bool."""


def _checked_columns(description: Description, path: Path) -> _Facts:
    keys = {
        "episode_index": 1,
        "frame_index": 1,
        "timestamp": 1,
        "observation.state": len(description.state_names),
        "action": len(description.action_names),
    }
    parts: list[tuple[Array, ...]] = []
    for batch in read_rows(path, list(keys)):
        one = {key: column([batch], key, path, width) for key, width in keys.items()}
        numbers = np.concatenate([one["observation.state"], one["action"]], axis=1)
        finite = np.asarray(np.isfinite(numbers).all(axis=1))
        plain = ("episode_index", "frame_index", "timestamp")
        parts.append((*(one[key][:, 0] for key in plain), finite))
    if not parts:
        raise UserError(f"{path}: expected rows, found none")
    return _Facts(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _row_fault(facts: _Facts, where: Array, length: int, fps: float) -> str:
    """The fault of an episode whose rows are ``where``; '' if there is none."""
    if len(where) != length:
        return f"expected {length} steps in the table, found {len(where)}"
    if where[-1] - where[0] + 1 != length or (facts.frame[where] != np.arange(length)).any():
        return "expected its steps in order"
    if not facts.finite[where].all():
        step = int(np.argmin(facts.finite[where]))
        return f"expected finite numbers, found others in step {step}"
    late = np.abs(facts.timestamp[where] * fps - np.arange(length))
    if not (late < 0.5).all():
        return f"expected {fps:g} steps a second, found other times"
    return ""


def _films(
    description: Description, row: _Row, extra: dict[str, Any]
) -> dict[str, tuple[Path, float, float]]:
    """By column: the film, and the seconds at which the episode begins and ends there."""
    films: dict[str, tuple[Path, float, float]] = {}
    for camera in description.cameras:
        if camera.kind != "video":
            continue
        stem = f"videos/{camera.key}"
        start = extra[f"{stem}/from_timestamp"]
        chunk = extra[f"{stem}/chunk_index"]
        file = extra[f"{stem}/file_index"]
        numbers = all(isinstance(one, int) for one in (chunk, file))
        if not (numbers and isinstance(start, float) and 0 <= start < 1e6):
            raise UserError(
                f"{description.root}: expected where episode {row.episode_index} lies in the "
                f"films of {camera.key}, found {[chunk, file, start]}"
            )
        path = description.film(camera.key, chunk, file)
        films[camera.key] = (path, start, start + row.length / description.fps)
    return films


def _film_fault(
    description: Description,
    films: dict[str, tuple[Path, float, float]],
    checked: Callable[..., str],
) -> str:
    for camera in description.cameras:
        if camera.key in films:
            path, _, end = films[camera.key]
            if fault := checked(path, camera, description.fps, end):
                return f"{camera.name}, {path.name}: {fault}"
    return ""
