"""Statistics of a dataset's columns and pictures, as LeRobot writes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from madviz.system.depth import depth_millimetres
from madviz.types import Array

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def described(column: Array) -> dict[str, list[float]]:
    """Statistics of (T, n), each with n numbers."""
    values = column.astype(np.float64)
    statistics = {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
        **{name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()},
    }
    return _listed(statistics, len(column))


def tally(frames: Sequence[Array]) -> Array:
    """(C, 256): how many pixels of T pictures (H, W, C) have each value, by channel."""
    stacked = np.stack(frames)  # (T, H, W, C)
    channels = range(stacked.shape[-1])
    return np.stack([np.bincount(stacked[..., c].ravel(), minlength=256) for c in channels])


def described_pictures(
    tallied: Array, count: int, span: tuple[float, float] | None
) -> dict[str, Any]:
    """Statistics of pictures from their ``tally``, each (C, 1, 1): of colours from 0 to 1, of depth
    between the metres of ``span`` in millimetres."""
    codes = np.arange(256)
    values = depth_millimetres(codes, span).astype(np.float64) if span else codes / 255
    total = tallied.sum(1)  # (C,)
    mean = tallied @ values / total  # (C, 256) @ (256,) -> (C,)
    below = tallied.cumsum(1) / total[:, None]  # (C, 256)
    statistics = {
        "min": values[(tallied > 0).argmax(1)],
        "max": values[255 - (tallied[:, ::-1] > 0).argmax(1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(tallied @ values**2 / total - mean**2, 0)),
        **{name: values[(below >= share).argmax(1)] for name, share in QUANTILES.items()},
    }
    return _listed({name: each.reshape(-1, 1, 1) for name, each in statistics.items()}, count)


def _listed(statistics: dict[str, Array], count: int) -> dict[str, Any]:
    """Statistics as LeRobot writes them, with the number of rows that they are of."""
    return {**{name: each.tolist() for name, each in statistics.items()}, "count": [count]}
