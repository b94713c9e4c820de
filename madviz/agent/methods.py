"""What a method trains on: the rows of one table.

A sample is encoded once per stream and then read several times: once *merged* (all streams summed)
and once for each *singular* subset, as if the other cameras were missing. A method says which
subsets those are, how much the two kinds weigh, and which feature its learning targets come from.
MAD with three streams and alpha 0.8 reads each sample four times:

    row         first + third_a + third_b    first    third_a    third_b
    weight      0.8                          0.0667   0.0667     0.0667     (0.2 in equal parts)
    targets     from the merged feature, in every row

Everything that trains (the losses, imitation, checkpoints' cards) asks this table, so that another
weighting or another list of subsets is another row of it and no other code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from madviz.subsets import mad_subsets, mask_of, name_of
from madviz.types import Array, UserError, unknown

Streams = tuple[str, ...]


@dataclass(frozen=True)
class Method:
    """One way to train; see the module for the words."""

    summary: str
    subsets: Callable[[Streams], Streams]
    """The singular subsets, by name."""
    weights: Callable[[float], dict[str, float]]
    """alpha -> the weight of each loss term: ``merged``, and ``singular``, a mean over subsets."""
    targets: Literal["merged", "own"] = "merged"
    """Where targets and the actor read Q: from the merged feature, or from each row's own."""
    recipes: tuple[str, ...] = ("paper", "light")
    needs: tuple[str, ...] = ()
    """What must be there to train it, in words, for ``madviz list``."""
    min_streams: int = 1

    def rows(self, streams: Streams) -> Streams:
        """The names of the N rows: the merged feature (``all``) first, then the subsets."""
        if len(streams) < self.min_streams:
            raise UserError(
                f"expected a setting with {self.min_streams} or more streams, found "
                f"{len(streams)} ({', '.join(streams)}); pick another setting or method"
            )
        return ("all", *self.subsets(streams))

    def masks(self, streams: Streams) -> Array:
        """(N, V) bool: which streams are present in each row."""
        return np.stack([mask_of(row, streams) for row in self.rows(streams)])

    def row_weights(self, streams: Streams, alpha: float) -> Array:
        """(N,) float32, the share of each row in a loss; they sum to 1."""
        weights, rows = self.weights(alpha), self.rows(streams)
        singular = weights.get("singular", 0.0) / max(len(rows) - 1, 1)
        return np.array([weights.get("merged", 0.0), *[singular] * (len(rows) - 1)], np.float32)

    def trained_subsets(self, streams: Streams) -> Streams:
        """The subsets a policy learns to work from; the rest is off-training."""
        names = [name_of(mask, streams) for mask in self.masks(streams)]
        return tuple(names if "merged" in self.weights(0.5) else names[1:])


def _mad(alpha: float) -> dict[str, float]:
    return {"merged": alpha, "singular": 1 - alpha}


METHODS: dict[str, Method] = {
    "mad": Method(
        "merge and disentangle: every trained subset is an augmentation of the merged feature",
        subsets=mad_subsets,
        weights=_mad,
        needs=("two or more streams",),
        min_streams=2,
    ),
    "merged-only": Method(
        "all streams summed and nothing else: the baseline that was never disentangled",
        subsets=lambda streams: (),
        weights=lambda alpha: {"merged": 1.0},
    ),
}


def method(name: str) -> Method:
    """The method called ``name``. Raises UserError listing the known ones."""
    if name not in METHODS:
        raise unknown("method", name, list(METHODS))
    return METHODS[name]
