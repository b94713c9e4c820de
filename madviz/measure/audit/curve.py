"""Success against one axis, from few episodes: where to look next, and what is known then.

The problem: how far may a camera turn before a policy fails? Twenty episodes at each of twenty
places are 400, most of them where nothing happens. The idea: a family of curves that fall away
from where the policy was trained, each with a probability. Every episode makes some of them less
likely, and the next one is played where it says most about which of them is right.

    kept(u) = (1 - lapse) * (rest + (1 - rest) * 2 ** -((u / half) ** steep)),   u from 0 to 1

``kept`` is the share of the scenes, solved with nothing changed, that are solved at ``u`` too. It
begins at 1 - lapse, because some scenes are lost by any change, and falls to ``rest``. This is a
Weibull curve. The grid of its four numbers with Bayes' rule is the psi method of Kontsevich and
Tyler (Vision Research 1999). Every episode is of another scene, so outcomes are independent,
wherever the earlier ones were played.

Worked: a policy fails from 0.3 on, and half of the prior lies on either side of 0.5. A success at
0.45 would leave the falling half-way; a failure there moves the next episodes below it. After 20
episodes the breaking point is known to some 0.04.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from madviz.types import Array

LEVEL = 0.98
"""The probability inside band and interval. Success may fall in another way than the family does;
with this one they hold the truth 95 times in 100 in simulated audits of several kinds."""
HALF = 0.5
"""The part of its success that is gone at the breaking point."""
_HALVES = np.r_[np.arange(0.0125, 1.0001, 0.0125), np.geomspace(1.03, 6, 12)]
_STEEP = np.geomspace(0.8, 150, 8)
_REST = np.array([0.0, 0.12, 0.28, 0.42, 0.6, 0.8])
_LAPSE = np.array([0.0, 0.04, 0.15])


@dataclass(frozen=True, eq=False)
class Family:
    """All curves, K, at the places P where episodes may be played."""

    kept: Array
    """(K, P) float32: the success that is kept."""
    success: Array
    """(K, P): its logarithm; that of its opposite is ``failure``."""
    failure: Array
    entropy: Array
    """(K, P): the uncertainty of an outcome, in nats."""
    breaking: Array
    """(K,) the place where half is gone, infinite where that is nowhere."""
    order: Array
    """(K,) the curves by ``breaking``; ``orders`` (K, P) has them by ``kept``."""
    orders: Array
    prior: Array
    """(K,) logarithms of probabilities before anything is played."""


@lru_cache(maxsize=8)
def family(places: tuple[float, ...]) -> Family:
    """The curves at ``places``, each in (0, 1]."""
    half, steep, rest, lapse = (
        axis.ravel() for axis in np.meshgrid(_HALVES, _STEEP, _REST, _LAPSE, indexing="ij")
    )  # (K,) each
    prior = np.where(rest == 0, 0.5, 0.1) * np.where(lapse == 0, 0.6, 0.2)
    # A quarter of the probability is that the end of the axis is not far enough.
    prior *= np.where(half <= 1, 0.75 / (_HALVES <= 1).sum(), 0.25 / (_HALVES > 1).sum())
    with np.errstate(over="ignore", under="ignore", divide="ignore", invalid="ignore"):
        fallen = np.exp2(-((np.array(places) / half[:, None]) ** steep[:, None]))  # (K, P)
        share = (HALF / (1 - lapse) - rest) / (1 - rest)
        breaking = np.where(share > 0, half * (-np.log2(share)) ** (1 / steep), np.inf)
    kept = (1 - lapse[:, None]) * (rest[:, None] + (1 - rest[:, None]) * fallen)
    kept = np.clip(kept, 1e-4, 1 - 1e-4).astype(np.float32)
    success = np.log(kept)
    failure = np.log1p(-kept)
    entropy = -kept * success - (1 - kept) * failure
    return Family(
        kept,
        success,
        failure,
        entropy,
        breaking,
        np.argsort(breaking, kind="stable"),
        np.argsort(kept, axis=0, kind="stable"),
        np.log(prior).astype(np.float32),
    )


class FallingCurve:
    """The probabilities of all curves, after the episodes of one side of an axis."""

    def __init__(self, places: tuple[float, ...]) -> None:
        self._family = family(places)
        self._log = self._family.prior  # (K,)

    def add(self, place: int, success: float) -> None:
        """Takes an episode at the place of that number; an expected outcome is a share."""
        curves = self._family
        observed = success * curves.success[:, place] + (1 - success) * curves.failure[:, place]
        self._log = self._log + observed

    def next(self, episodes: int) -> list[int]:
        """The numbers of the places for the next ``episodes``, which are played together: each is
        chosen as if those before had come out as expected."""
        known = self._log
        chosen = []
        for _ in range(episodes):
            weights = self._weights()
            rates = np.clip(weights @ self._family.kept, 1e-6, 1 - 1e-6)  # (P,)
            uncertain = -rates * np.log(rates) - (1 - rates) * np.log1p(-rates)
            place = int(np.argmax(uncertain - weights @ self._family.entropy))
            chosen.append(place)
            self.add(place, float(rates[place]))
        self._log = known
        return chosen

    def breaking(self) -> tuple[float, float, float]:
        """The place where half is gone: median, low and high end; above 1 where it lies beyond the
        axis, infinite where it is nowhere."""
        curves = self._family
        low, middle, high = _quantiles(curves.breaking, curves.order, self._weights())
        return middle, low, high

    def band(self) -> tuple[Array, Array, Array]:
        """The success that is kept at every place, (P,) each: median, low and high end, by whole
        hundredths outwards."""
        weights = self._weights()
        pairs = zip(self._family.kept.T, self._family.orders.T, strict=True)
        rows = np.array([_quantiles(*pair, weights) for pair in pairs])  # (P, 3)
        low, middle, high = rows.T
        return middle, np.floor(100 * low) / 100, np.ceil(100 * high) / 100

    def _weights(self) -> Array:
        weights = np.exp(self._log - self._log.max())
        return weights / weights.sum()


def _quantiles(values: Array, order: Array, weights: Array) -> list[float]:
    """Low end, median and high end of ``values`` (K,), in their ``order`` (K,), by their
    probabilities (K,)."""
    below = np.cumsum(weights[order], dtype=float)
    shares = np.array([(1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2]) * below[-1]
    return [float(values[order[place]]) for place in np.searchsorted(below, shares)]
