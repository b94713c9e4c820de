"""States and actions between -1 and 1, and back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from madviz.types import Array


@dataclass(frozen=True)
class Scaling:
    """scaled = 2 (x - low) / (high - low) - 1. Numbers that never changed become 0."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def scale(self, x: Array) -> Array:
        """(..., n) raw -> (..., n) float32; beyond [-1, 1] where ``x`` is out of range."""
        low, span = self._bounds()
        scaled = 2 * (np.asarray(x, np.float64) - low) / np.where(span > 0, span, 1) - 1
        return np.where(span > 0, scaled, 0).astype(np.float32)

    def unscale(self, x: Array) -> Array:
        """(..., n) scaled -> (..., n) float32 raw."""
        low, span = self._bounds()
        return (low + (np.asarray(x, np.float64) + 1) / 2 * span).astype(np.float32)

    def to_json(self) -> dict[str, list[float]]:
        return {"low": list(self.low), "high": list(self.high)}

    def _bounds(self) -> tuple[Array, Array]:
        low = np.array(self.low)
        return low, np.array(self.high) - low


def scaling_of(columns: Iterable[Array]) -> Scaling:
    """The least and largest of every number in ``columns``, each (T, n)."""
    bounds = [(column.min(0), column.max(0)) for column in columns]
    low = np.min([one for one, _ in bounds], axis=0)
    high = np.max([one for _, one in bounds], axis=0)
    return Scaling(tuple(low.tolist()), tuple(high.tolist()))


def each_apart(actions: Array, others: Array, spread: Array | Sequence[float]) -> Array:
    """(..., A) twice -> (..., A): how far each number is apart in units of its ``spread`` (A,), on
    one scale; 0 for a number of spread 0, which never changes in the recordings."""
    units = np.asarray(spread, np.float64)
    moving = units > 0
    difference = np.asarray(actions, np.float64) - np.asarray(others, np.float64)
    return np.where(moving, np.abs(difference) / np.where(moving, units, 1), 0)


def apart(actions: Array, others: Array, spread: Array | Sequence[float]) -> Array:
    """(..., A) twice -> (...): the root mean square of ``each_apart`` over the numbers that change;
    NaN where one of these is not finite."""
    moving = np.count_nonzero(np.asarray(spread))
    squares = each_apart(actions, others, spread) ** 2
    return np.sqrt(squares.sum(axis=-1) / max(moving, 1))


def spread_of(columns: Sequence[Array]) -> Array:
    """(n,) float32, the standard deviation of every number in ``columns``, each (T, n); 1 where it
    is 0."""
    spread = np.concatenate(columns).astype(np.float64).std(axis=0)
    return np.where(spread > 0, spread, 1).astype(np.float32)
