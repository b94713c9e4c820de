"""The reading of one time step under every subset of a policy's streams at once.

Each stream is encoded once. Every subset's merged feature is a masked sum of those rows, so reading
all of them is one batch through the heads: with three streams 8 rows, with six 64. Switching a
camera off then reads a row of this table, and no network runs for it.

Policies with other merges may look at all their cameras in one pass, so that every subset costs a
pass: at 40 ms each, 8 rows take 0.3 s. Of those, the table holds the rows somebody asked for, and
``read_row`` adds one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from madviz.subsets import every_mask, row_of
from madviz.types import Array, Encoded, Policy, Readout

Merged = Literal["sum", "mean", "other", "no views"]


@dataclass(frozen=True)
class Probe:
    """The features of one time step and what every subset of them would do."""

    features: Float[Array, "V Z"]
    """One row per stream."""
    masks: Bool[Array, "N V"]
    """Every subset; the full one first, the empty one last."""
    supported: Bool[Array, " N"]
    """Rows of ``readout`` that this policy cannot give (False) are NaN."""
    readout: Readout
    known: Bool[Array, " N"]
    """Rows that were read; the others are NaN, too."""

    @property
    def waiting(self) -> Bool[Array, " N"]:
        """Rows that could be read, and were not."""
        return self.supported & ~self.known

    def row(self, mask: Array) -> int:
        """Where ``mask`` (V,) stands in ``masks``."""
        return row_of(mask)

    @property
    def norms(self) -> Float[Array, " V"]:
        """(V,) norms of the stream features."""
        return np.linalg.norm(self.features, axis=1)

    def merged(self, row: int) -> Float[Array, " Z"]:
        """(Z,) float32 merged feature; a timeline's past may be rounded to half of that."""
        return self.readout.merged[row].astype(np.float32, copy=False)

    def merged_norm(self, row: int) -> float:
        return float(np.linalg.norm(self.merged(row)))

    def cosines(self, row: int) -> Float[Array, " V"]:
        """(V,) cosine of every stream's feature to the merged one; NaN where one has norm 0."""
        merged = self.merged(row)
        norms = self.norms * np.linalg.norm(merged)
        if merged.shape != self.features.shape[1:]:
            return np.full(len(self.features), np.nan)
        dots = self.features @ merged
        return np.divide(dots, norms, out=np.full(len(dots), np.nan), where=norms > 1e-12)

    def shares(self, row: int) -> Float[Array, " V"]:
        """(V,) how much of the merged feature M of ``row`` each stream explains, V_i . M / |M|^2.

        Where M is a sum they add up to 1, because the V_i . M add up to M . M; for a mean each is
        divided by the number of streams, and they do so, too. 0 for an absent stream; NaN where M
        has norm 0 or is no sum and no mean.
        """
        kind = self.merged_kind()
        mask = self.masks[row]
        merged = self.merged(row)
        if kind not in ("sum", "mean") or not float(merged @ merged) > 1e-12:
            return np.full(len(self.features), np.nan)
        parts = np.where(mask, self.features @ merged / (merged @ merged), 0.0)
        return parts / mask.sum() if kind == "mean" else parts

    def merged_kind(self) -> Merged:
        """The kind of the merged feature, read off the numbers themselves: policies of one method
        may merge differently. ``no views``: no stream has a feature of its own."""
        if not self.features.any():
            return "no views"
        fullest = int(np.argmax(np.where(self.known, self.masks.sum(1), -1)))
        merged = self.merged(fullest)
        mask = self.masks[fullest]
        if merged.shape != self.features.shape[1:]:
            return "other"
        total = self.features[mask].sum(0)
        near = 1e-3 * max(float(np.linalg.norm(total)), 1e-9)
        if np.linalg.norm(merged - total) <= near:
            return "sum"
        count = max(int(mask.sum()), 1)
        return "mean" if np.linalg.norm(merged - total / count) <= near / count else "other"


def probe(
    policy: Policy,
    encoded: Encoded,
    masks: Bool[Array, "N V"] | None = None,
    only: int | None = None,
) -> Probe:
    """Reads every subset of ``encoded`` that ``policy`` supports, in one pass. With ``only``, reads
    that row alone; where the policy does not support it, the first row that it does."""
    if masks is None:
        masks = every_mask(len(policy.spec.streams))  # (N, V)
    supported = np.array([policy.supports(mask) for mask in masks], bool)  # (N,)
    known = supported
    if only is not None:
        row = only if supported[only] else int(np.argmax(supported))
        known = np.arange(len(masks)) == row  # (N,) with one True
    readout = policy.read(encoded, masks[known])  # One row for each True in ``known``.
    return Probe(encoded.features, masks, supported, _spread(readout, known), known)


def read_row(before: Probe, policy: Policy, encoded: Encoded, row: int) -> Probe:
    """``before`` and ``row``, which costs a pass where it is not known yet and can be read."""
    if before.known[row] or not before.supported[row]:
        return before
    read = policy.read(encoded, before.masks[row : row + 1])  # Its tables have one row.

    def with_row(table: Array, values: Array) -> Array:
        table = table.copy()
        table[row] = values[0]
        return table

    readout = Readout(
        with_row(before.readout.merged, read.merged),  # (N, Z)
        with_row(before.readout.action, read.action),  # (N, A)
        with_row(before.readout.q, read.q),  # (N,)
    )
    known = before.known.copy()
    known[row] = True
    return replace(before, readout=readout, known=known)


def _spread(readout: Readout, known: Bool[Array, " N"]) -> Readout:
    """Puts the rows that were read into their places among all N, NaN elsewhere."""
    if known.all():
        return readout

    def fill(values: Array) -> Array:
        spread = np.full((len(known), *values.shape[1:]), np.nan, np.float32)  # (N, ...)
        spread[known] = values
        return spread

    return Readout(fill(readout.merged), fill(readout.action), fill(readout.q))
