"""A map of features: thousands of numbers per view, drawn as a point that never jumps.

The problem: a feature has 3136 numbers and a page two axes. A principal component analysis of what
is on the page now would turn and stretch with every frame, and nobody could tell a moving point
from a moving map.

The idea: collect features for a while, compute the two directions in which they differ most, once,
and store them. From then on a point is (feature - mean) @ axes, and its path over the map shows
how the policy's features change. The sign of an axis is arbitrary; here its greatest entry is
positive.

Worked: of 40 decisions and three views come 120 rows of 3136. Their directions are those of a
120 x 120 table of dot products (8 ms), so the 3136 x 3136 covariance is never formed.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from madviz.errors import UserError
from madviz.types import Array

DECISIONS = 40
"""Time steps a map is made of."""


@dataclass(frozen=True)
class Basis:
    """Two fixed directions in the space of features."""

    mean: Float[Array, " Z"]
    """Where the map's origin is."""
    axes: Float[Array, "2 Z"]
    """The axes, of norm 1 and at right angles; zeros where features differ in fewer directions."""
    share: float
    """The share of the features' variance that the two axes show, in [0, 1]."""
    low: Float[Array, 2]
    """The least coordinates of what it was made of."""
    high: Float[Array, 2]
    """The greatest."""

    def project(self, features: Float[Array, "... Z"]) -> Float[Array, "N 2"]:
        """Rows of features, or one, to points, float64."""
        return (np.atleast_2d(features).astype(np.float64) - self.mean) @ self.axes.T


def fit(features: Array) -> Basis:
    """The principal axes of (N, Z). Raises UserError for fewer than two rows or ones that are not
    finite."""
    rows = np.asarray(features, np.float64)
    if len(rows) < 2 or not np.isfinite(rows).all():
        raise UserError(
            f"expected two or more finite features to make a map of, found {len(rows)} "
            "rows or numbers that are not finite; play some more steps"
        )
    mean = rows.mean(0)
    centred = rows - mean
    variance, turns = np.linalg.eigh(centred @ centred.T)
    variance = np.maximum(variance[::-1], 0)
    turns = turns[:, ::-1]
    axes = np.zeros((2, rows.shape[1]))
    for axis in range(2):
        if variance[axis] > 1e-12 * max(variance[0], 1e-12):
            axes[axis] = centred.T @ turns[:, axis] / np.sqrt(variance[axis])
            axes[axis] *= np.sign(axes[axis, np.abs(axes[axis]).argmax()])
    points = centred @ axes.T
    share = float(variance[:2].sum() / max(variance.sum(), 1e-300))
    return Basis(mean, axes, share, points.min(0), points.max(0))


class FeatureMaps:
    """A map per policy, made of the first ``DECISIONS`` time steps of it, and then fixed."""

    def __init__(self, decisions: int = DECISIONS) -> None:
        self._decisions = decisions
        self._seen: dict[Hashable, list[Array]] = {}
        self._maps: dict[Hashable, Basis] = {}

    def collect(self, key: Hashable, features: Array) -> None:
        """Takes the features (V, Z) of one more time step of the policy ``key``."""
        if key in self._maps or not np.isfinite(features).all():
            return
        seen = self._seen.setdefault(key, [])
        seen.append(features)
        if len(seen) >= self._decisions:
            self._maps[key] = fit(np.concatenate(self._seen.pop(key)))

    def map(self, key: Hashable) -> Basis | None:
        """The map of the policy ``key``; None until there is one."""
        return self._maps.get(key)

    def progress(self, key: Hashable) -> float:
        """How much of what a map is made of has been seen, 0 to 1."""
        return 1.0 if key in self._maps else len(self._seen.get(key, [])) / self._decisions
