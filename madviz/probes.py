"""What a policy makes of one instant, under every subset of its streams at once.

Each stream is encoded once. Every subset's merged feature is a masked sum of those rows, so reading
all of them is one batch through the heads: with three streams 8 rows, with six 64. Switching a
camera off is then a look-up in this table, and no network runs for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from madviz.subsets import every_mask
from madviz.types import Array, Encoded, Policy, Readout


@dataclass(frozen=True)
class Probe:
    """The features of one instant and what every subset of them would do."""

    features: Array
    """(V, Z) one row per stream."""
    masks: Array
    """(N, V) bool, every subset; the full one first, the empty one last."""
    supported: Array
    """(N,) bool; rows of ``readout`` that this policy cannot give are NaN."""
    readout: Readout

    def row(self, mask: Array) -> int:
        """Where ``mask`` (V,) stands in ``masks``: its bits as a binary number, inverted."""
        bits = np.asarray(mask, bool)
        return int((~bits) @ (1 << np.arange(len(bits))[::-1]))

    @property
    def norms(self) -> Array:
        """(V,) lengths of the stream features."""
        return np.linalg.norm(self.features, axis=1)

    def merged_norm(self, row: int) -> float:
        return float(np.linalg.norm(self.readout.merged[row]))

    def cosines(self, row: int) -> Array:
        """(V,) cosine of every stream's feature to the merged one; NaN where one has no length."""
        merged = self.readout.merged[row]
        lengths = self.norms * np.linalg.norm(merged)
        if merged.shape != self.features.shape[1:]:
            return np.full(len(self.features), np.nan)
        dots = self.features @ merged
        return np.divide(dots, lengths, out=np.full(len(dots), np.nan), where=lengths > 1e-12)


def probe(policy: Policy, encoded: Encoded, masks: Array | None = None) -> Probe:
    """Reads every subset of ``encoded`` that ``policy`` supports, in one pass."""
    if masks is None:
        masks = every_mask(len(encoded.features))
    supported = np.array([policy.supports(mask) for mask in masks], bool)
    known = policy.read(encoded, masks[supported])
    return Probe(encoded.features, masks, supported, _spread(known, supported))


def _spread(known: Readout, supported: Array) -> Readout:
    """Puts the rows that could be read into their places among all N, NaN elsewhere."""
    if supported.all():
        return known

    def fill(values: Array) -> Array:
        spread = np.full((len(supported), *values.shape[1:]), np.nan, np.float32)
        spread[supported] = values
        return spread

    return Readout(fill(known.merged), fill(known.action), fill(known.q))
