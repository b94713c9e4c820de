"""A picture as a few whole numbers, which every language computes alike.

The picture is cut into 21 x 21 cells of about equal size. A cell holds the sum of all its pixels
and colours. Every fourth row of the middle colour channel gives the differences of neighbours.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from madviz.errors import UserError
from madviz.types import Array

CELLS = 21
"""Cells in a row and in a column."""
ROWS = 4
"""Differences of neighbours are taken in every fourth row."""
LARGEST = 2048
"""Rows and columns of a picture, at most: the sums of larger ones are not exact."""
DARK = 8
"""A cell is dark where its pixels are at most this on average, of 255."""
EDGE = 16
"""Two neighbours that differ by this or more are an edge."""


class PictureSums(NamedTuple):
    """The numbers of one picture."""

    cells: Array
    """(441,) float64, whole numbers: the sums of the cells, row by row."""
    spread: float
    """The standard deviation of ``cells``: 0 for an even picture."""
    dark: int
    """How many cells are dark."""
    rough: int
    """The sum of the differences of neighbours: large for noise."""
    edges: int
    """How many neighbours are edges: few in a blurred picture."""


def sums_of(picture: Array) -> PictureSums:
    """The numbers of ``picture``, (H, W, 3) or (H, W, 1) uint8. One channel counts three times.
    Raises UserError for another shape or type, and for a size that is not from 21 to 2048."""
    shape = np.shape(picture)
    good = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and len(shape) == 3
    fits = good and shape[2] in (1, 3) and CELLS <= min(shape[:2]) <= max(shape[:2]) <= LARGEST
    if not fits:
        kind = getattr(picture, "dtype", type(picture).__name__)
        raise UserError(
            f"expected a picture (H, W, 3) uint8 of {CELLS} to {LARGEST} rows and columns, "
            f"found {shape} {kind!s:.40}"
        )
    if shape[2] == 1:
        picture = np.broadcast_to(picture, (*shape[:2], 3))  # (H, W, 3)
    colours = picture.astype(np.float32)
    grey = colours[..., 0] + colours[..., 1]
    grey += colours[..., 2]  # (H, W)
    by_row, by_column, darkest = _grid(shape[0], shape[1])
    # Whole numbers below 2^24 are exact in float32, and its products are the fastest.
    cells = (by_row @ grey @ by_column).ravel().astype(np.float64)  # (441,)
    total = float(cells.sum())
    square = float(cells @ cells)
    lines = picture[::ROWS, :, 1].astype(np.int16)
    steps = lines[:, 1:] - lines[:, :-1]  # (H / 4, W - 1)
    np.abs(steps, out=steps)
    return PictureSums(
        cells=cells,
        spread=max(len(cells) * square - total * total, 0) ** 0.5 / len(cells),
        dark=int(np.count_nonzero(cells <= darkest)),
        rough=int(steps.sum(dtype=np.int64)),
        edges=int(np.count_nonzero(steps >= EDGE)),
    )


@lru_cache(maxsize=16)
def _grid(rows: int, columns: int) -> tuple[Array, Array, Array]:
    """The cells of pictures of one size: (21, H) float32, 1 where a row belongs to a row of cells;
    likewise (W, 21), of columns; and (441,), the largest sum of each dark cell."""
    by_row = _membership(rows)  # (21, H)
    by_column = np.ascontiguousarray(_membership(columns).T)  # (W, 21)
    sizes = np.multiply.outer(by_row.sum(1), by_column.sum(0))  # (21, 21)
    return by_row, by_column, 3 * DARK * sizes.ravel()


def _membership(count: int) -> Array:
    """(21, count) float32: 1 where a row, or column, belongs to a cell."""
    cell = np.searchsorted(np.arange(CELLS) * count // CELLS, np.arange(count), side="right") - 1
    return (np.arange(CELLS)[:, None] == cell).astype(np.float32)
