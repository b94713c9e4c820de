"""A picture as a few whole numbers, which every language computes alike.

The picture is cut into 21 x 21 cells of about equal size. A cell holds the sum of all its pixels
and colours. Every fourth row of the middle colour channel gives the differences of neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from madviz.errors import UserError
from madviz.types import Array

CELLS = 21
"""Cells in a row and in a column."""
ROWS = 4
"""Differences of neighbours are taken in every fourth row."""
DARK = 8
"""A cell is dark where its pixels are at most this on average, of 255."""
EDGE = 16
"""Two neighbours that differ by this or more are an edge."""


@dataclass(frozen=True, eq=False)
class PictureSums:
    """The numbers of one picture."""

    cells: Array
    """(441,) int64: the sums of the cells, row by row."""
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
    Raises UserError for another shape or type, and for fewer than 21 rows or columns."""
    shape = np.shape(picture)
    good = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and len(shape) == 3
    if not good or shape[2] not in (1, 3) or min(shape[:2]) < CELLS:
        kind = getattr(picture, "dtype", type(picture).__name__)
        raise UserError(
            f"expected a picture (H, W, 3) uint8 of {CELLS} rows and columns or more, found "
            f"{shape} {kind!s:.40}"
        )
    if shape[2] == 1:
        picture = np.broadcast_to(picture, (*shape[:2], 3))  # (H, W, 3)
    rows = np.arange(CELLS) * shape[0] // CELLS
    columns = np.arange(CELLS) * shape[1] // CELLS
    grey = picture[..., 0].astype(np.int64)
    grey += picture[..., 1]
    grey += picture[..., 2]  # (H, W)
    cells = np.add.reduceat(np.add.reduceat(grey, rows, 0), columns, 1).ravel()  # (441,)
    heights = np.diff(rows, append=shape[0])
    widths = np.diff(columns, append=shape[1])
    pixels = np.multiply.outer(heights, widths).ravel()
    total = int(cells.sum())
    square = int(cells @ cells)
    lines = picture[::ROWS, :, 1].astype(np.int16)
    steps = np.abs(np.diff(lines, axis=1))  # (H / 4, W - 1)
    return PictureSums(
        cells=cells,
        spread=max(len(cells) * square - total * total, 0) ** 0.5 / len(cells),
        dark=int((cells <= 3 * DARK * pixels).sum()),
        rough=int(steps.sum(dtype=np.int64)),
        edges=int((steps >= EDGE).sum()),
    )
