"""The tables of a dataset, read in pieces: no more rows in memory than were asked for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq

from madviz.errors import UserError
from madviz.types import Array

compute: Any = pyarrow.compute  # Its functions are made while it is imported.
AT_ONCE = 64
"""Rows with pictures in memory at a time."""
NUMBERS_AT_ONCE = 65_536
"""Rows of numbers alone."""


def rows_of(path: Path) -> int:
    """Raises UserError for a file that is not there or no table."""
    return _opened(path).metadata.num_rows


def read_rows(
    path: Path,
    columns: list[str],
    first: int = 0,
    count: int | None = None,
    at_once: int = NUMBERS_AT_ONCE,
) -> Iterator[pa.RecordBatch]:
    """``count`` rows from ``first`` on, in batches. Only row groups that hold some are read.
    Raises UserError for a file that is not a table or lacks a column."""
    file = _opened(path)
    missing = [name for name in columns if name not in file.schema_arrow.names]
    if missing:
        raise UserError(f"{path}: expected a column {missing[0]!r}, found none")
    last = file.metadata.num_rows if count is None else first + count
    groups: list[int] = []
    begin = 0  # The first row of the groups.
    at = 0
    for number in range(file.metadata.num_row_groups):
        size = file.metadata.row_group(number).num_rows
        if at < last and at + size > first:
            begin = begin if groups else at
            groups.append(number)
        at += size
    if not groups:
        return
    try:
        for batch in file.iter_batches(at_once, row_groups=groups, columns=columns):
            low = max(first - begin, 0)
            high = min(last - begin, batch.num_rows)
            begin += batch.num_rows
            if low < high:
                yield batch.slice(low, high - low)
            if begin >= last:
                return
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def column(batches: list[pa.RecordBatch], name: str, path: Path, width: int) -> Array:
    """(T, width) float64 of the column ``name``. Raises UserError for other kinds and widths."""
    values = pa.chunked_array([batch.column(name) for batch in batches])
    try:
        if pa.types.is_nested(values.type):
            lengths = compute.list_value_length(values)
            if values.null_count or set(compute.unique(lengths).to_pylist()) != {width}:
                raise ValueError(f"rows of {compute.unique(lengths).to_pylist()[:3]}")
            values = compute.list_flatten(values)
        elif width != 1:
            raise ValueError(f"{values.type}")
        kind = values.type
        if values.null_count or not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
            raise ValueError(f"{values.type} with {values.null_count} empty")
        return np.asarray(values.to_numpy(), np.float64).reshape(-1, width)
    except (ValueError, pa.ArrowException) as error:
        what = "one number" if width == 1 else f"{width} numbers"
        raise UserError(
            f"{path}: expected {name!r} to hold {what} in each row, found {error}"
        ) from error


def _opened(path: Path) -> Any:
    try:
        return pq.ParquetFile(path)
    except (pa.ArrowException, OSError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> UserError:
    found = "none" if isinstance(error, FileNotFoundError) else f"{error}"
    return UserError(f"{path}: expected a table (parquet), found {found:.160}")
