"""Success rates and paired differences, and how far to trust them.

Ten episodes say little: 8 of 10 is compatible with anything from 0.49 to 0.94. So no success rate
goes anywhere in this package without its episode count and its Wilson interval, and two policies
are compared on the same seeds, where only the episodes that came out differently count.

    8 of 10     0.80   [0.49, 0.94]
    80 of 100   0.80   [0.71, 0.87]

Wilson (1927) inverts the score test, so it stays inside [0, 1] and does not shrink to nothing at 0
of n or n of n. Newcombe (1998, second paper, method 10) builds the interval of a paired difference
from the two Wilson intervals. ``formulas.py`` has the arithmetic.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import nan
from typing import TypedDict

from madviz.errors import UserError
from madviz.measure.formulas import (
    agresti_min,
    mcnemar,
    mcnemar_any_time,
    newcombe,
    student,
    wilson_bounds,
)
from madviz.policies.measured import RateRow
from madviz.types import Array

Interval = tuple[float, float]


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

    @classmethod
    def counted(cls, outcomes: Iterable[bool]) -> SuccessRate:
        """The rate of ``outcomes``, one for each episode."""
        successes = [bool(success) for success in outcomes]
        return cls.of(sum(successes), len(successes))

    @classmethod
    def mean(cls, shares: Sequence[float], parts: int) -> SuccessRate:
        """The mean over ``parts`` success rates of the same seeds, with ``mean_interval``."""
        return cls(sum(shares) / len(shares), mean_interval(shares, parts), len(shares))

    @classmethod
    def read(cls, row: RateRow) -> SuccessRate:
        """The rate that a document holds."""
        low, high = row["ci95"]
        return cls(row["success"], (low, high), row["n"])

    def row(self) -> RateRow:
        """All of it, for a document."""
        return {"success": self.value, "n": self.n, "ci95": list(self.interval)}

    @property
    def without_count(self) -> str:
        """``0.90 [0.79, 0.96]``, where the count of episodes stands beside it."""
        low, high = self.interval
        return f"{self.value:.2f} [{low:.2f}, {high:.2f}]"

    def __str__(self) -> str:
        """How a rate is written everywhere: ``0.90 [0.79, 0.96] n=50``."""
        return f"{self.without_count} n={self.n}"


def wilson(successes: int, n: int, confidence: float = 0.95) -> Interval:
    """Interval of a success rate; (0, 1) where nothing was tried.

    Raises UserError unless 0 <= successes <= n. Closed form, because the page asks for it at every
    result and importing scipy.stats takes most of a second; the tests hold it against scipy's.
    """
    if not 0 <= successes <= n:
        raise UserError(f"expected 0 <= successes <= n, found {successes} of {n}")
    return _floats(wilson_bounds(successes, n, confidence)) if n else (0.0, 1.0)


class PairedRow(TypedDict):
    """A ``Paired`` as documents hold it."""

    n: int
    """Seeds."""
    first_only: int
    second_only: int
    difference: float
    ci95: list[float]
    """Newcombe's interval of ``difference``."""
    p: float
    """McNemar's, exact."""


@dataclass(frozen=True)
class Paired:
    """Two policies, or two conditions, on the same seeds, counted by how both came out."""

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

    def row(self) -> PairedRow:
        """All of it, for a document."""
        return {
            "n": self.n,
            "first_only": self.first_only,
            "second_only": self.second_only,
            "difference": self.difference,
            "ci95": list(self.interval()),
            "p": self.mcnemar(),
        }

    def interval(self) -> Interval:
        """Newcombe's 95% interval of the paired difference (method 10, 1998, second paper)."""
        return _floats(newcombe(self.both, self.first_only, self.second_only, self.neither))

    def mcnemar(self) -> float:
        """Exact two-sided p-value of 'both are equally good': the episodes that came out
        differently must then be a fair coin. 1 where none did."""
        return float(mcnemar(self.first_only, self.second_only))

    def any_time(self) -> float:
        """As ``mcnemar``, for a count that is looked at while it grows: larger, and valid whenever
        somebody looks."""
        return float(mcnemar_any_time(self.first_only, self.second_only))


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
    return _floats(wilson_bounds(count, n * independent))


def difference_interval(differences: Sequence[float]) -> Interval:
    """95% interval of a mean of paired differences, each in [-1, 1]; see ``agresti_min``."""
    return _floats(agresti_min(differences))


def interval_over_trainings(
    groups: Sequence[Sequence[Sequence[float]]], episodes: Interval, least: float = 0.0
) -> Interval:
    """95% interval of a mean over several trainings: Student's, of ``student``'s groups.

    ``episodes``: the interval over the episodes of these very trainings. It is part of the result:
    three trainings that agree by chance are no proof that the next one would, and a rate of 1 must
    not have an interval of nothing.
    """
    low, high = student(groups, least)
    return min(low, episodes[0]), max(high, episodes[1])


def _floats(ends: tuple[Array, Array]) -> Interval:
    return float(ends[0]), float(ends[1])
