"""What a count of successes says, and how far to trust it.

Ten episodes say little: 8 of 10 is compatible with anything from 0.49 to 0.94. So no success rate
goes anywhere in this package without its episode count and its Wilson interval, and two policies
are compared on the same seeds, where only the episodes that came out differently count.

    8 of 10     0.80   [0.49, 0.94]
    80 of 100   0.80   [0.71, 0.87]

Wilson (1927) inverts the score test, so it stays inside [0, 1] and does not shrink to nothing at 0
of n or n of n. Newcombe (1998, second paper, method 10) builds the interval of a paired difference
from the two Wilson intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan, sqrt
from statistics import NormalDist

from madviz.errors import UserError

Interval = tuple[float, float]
Z95 = NormalDist().inv_cdf(0.975)


@dataclass(frozen=True)
class SuccessRate:
    """A success rate and how far to trust it."""

    value: float
    """NaN where nothing was tried."""
    interval: Interval
    """95%."""
    n: int
    """Episodes; a mean over several subsets has as many of each."""

    @classmethod
    def of(cls, successes: int, n: int) -> SuccessRate:
        """``successes`` of ``n`` episodes, with Wilson's interval."""
        return cls(successes / n if n else nan, wilson(successes, n), n)

    @property
    def successes(self) -> int:
        """Of ``n`` episodes."""
        return round(self.value * self.n) if self.n else 0

    def __str__(self) -> str:
        """How a rate is written everywhere: ``0.90 [0.79, 0.96] n=50``."""
        low, high = self.interval
        return f"{self.value:.2f} [{low:.2f}, {high:.2f}] n={self.n}"


def wilson(successes: int, n: int, confidence: float = 0.95) -> Interval:
    """Interval of a success rate; (0, 1) where nothing was tried.

    Raises UserError unless 0 <= successes <= n. Closed form, because the page asks for it at every
    result and importing scipy.stats takes most of a second; the tests hold it against scipy's.
    """
    if not 0 <= successes <= n:
        raise UserError(f"expected 0 <= successes <= n, found {successes} of {n}")
    return _wilson(successes, n, confidence) if n else (0.0, 1.0)


def _wilson(successes: float, n: float, confidence: float) -> Interval:
    """Also for counts that are not whole, n above 0."""
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate, shrink = successes / n, 1 / (1 + z * z / n)
    centre = shrink * (rate + z * z / (2 * n))
    half = shrink * z * sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # At 0 of n and n of n the bound is exact; rounding must not push it off.
    low = 0.0 if successes == 0 else max(centre - half, 0.0)
    high = 1.0 if successes == n else min(centre + half, 1.0)
    return low, high


@dataclass(frozen=True)
class Paired:
    """Two policies on the same seeds, counted by how both came out."""

    both: int
    first_only: int
    second_only: int
    neither: int

    @property
    def n(self) -> int:
        """Seeds."""
        return self.both + self.first_only + self.second_only + self.neither

    @property
    def difference(self) -> float:
        """Success rate of the first minus that of the second; 0 where nothing was tried."""
        return (self.first_only - self.second_only) / self.n if self.n else 0.0

    def interval(self) -> Interval:
        """Newcombe's 95% interval of the paired difference (method 10, 1998, second paper)."""
        if self.n == 0:
            return -1.0, 1.0
        first, second = self.both + self.first_only, self.both + self.second_only
        p, q, correlation = first / self.n, second / self.n, self._correlation()
        (p_low, p_high), (q_low, q_high) = wilson(first, self.n), wilson(second, self.n)

        def reach(a: float, b: float) -> float:
            return sqrt(max(a * a - 2 * correlation * a * b + b * b, 0.0))

        low = p - q - reach(p - p_low, q_high - q)
        high = p - q + reach(p_high - p, q - q_low)
        return max(low, -1.0), min(high, 1.0)

    def mcnemar(self) -> float:
        """Exact two-sided p-value of 'both are equally good': the episodes that came out
        differently must then be a fair coin. 1 where none did."""
        from scipy.stats import binomtest

        different = self.first_only + self.second_only
        return float(binomtest(self.first_only, different).pvalue) if different else 1.0

    def _correlation(self) -> float:
        """Newcombe's phi, with his continuity correction towards 0 for positive association."""
        both, first, second, neither = self.both, self.first_only, self.second_only, self.neither
        product = (both + first) * (second + neither) * (both + second) * (first + neither)
        if product == 0:
            return 0.0
        association = both * neither - first * second
        if association > 0:
            association = max(association - self.n / 2, 0)
        return association / sqrt(product)


def pair(first: Mapping[int, bool], second: Mapping[int, bool]) -> Paired:
    """Counts outcomes by seed over the seeds that both have."""
    outcomes = [(first[seed], second[seed]) for seed in first if seed in second]
    return Paired(
        both=outcomes.count((True, True)),
        first_only=outcomes.count((True, False)),
        second_only=outcomes.count((False, True)),
        neither=outcomes.count((False, False)),
    )


def mean_interval(shares: Sequence[float], parts: int) -> Interval:
    """95% interval of a mean over ``parts`` success rates that were measured on the same seeds.

    ``shares`` has one number for each seed: the share of its ``parts`` episodes that succeeded.
    Episodes of one seed resemble each other, so 4 x 100 of them say as much as 100 to 400
    independent ones: Wilson's interval at the number whose mean would scatter as much.
    """
    n = len(shares)
    if n == 0:
        return 0.0, 1.0
    mean = sum(shares) / n
    scatter = sum((share - mean) ** 2 for share in shares) / n
    independent = min(max(mean * (1 - mean) / scatter, 1.0), parts) if scatter > 0 else 1.0
    # The ends must be the ends also where a sum of thirds is a hair off.
    count = n * independent * (0.0 if max(shares) == 0 else 1.0 if min(shares) == 1 else mean)
    return _wilson(count, n * independent, 0.95)


def difference_interval(differences: Sequence[float]) -> Interval:
    """95% interval of a mean of paired differences, each in [-1, 1].

    Agresti and Min (2005): the usual interval after adding half a pair to each of the four ways in
    which two episodes can come out together, so that it neither shrinks to nothing where all
    differences are equal nor needs many seeds. Theirs is for 0, 1 and -1; shares lie between.
    """
    n = len(differences)
    if n == 0:
        return -1.0, 1.0
    mean = sum(differences) / (n + 2)
    squares = sum(difference**2 for difference in differences) + 1
    half = Z95 * sqrt(max(squares / (n + 2) - mean**2, 0.0) / (n + 2))
    return max(mean - half, -1.0), min(mean + half, 1.0)
