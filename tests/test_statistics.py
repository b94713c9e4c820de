"""Intervals and paired comparisons, held against scipy and against exact coverage."""

import numpy as np
import pytest
from scipy.stats import binomtest, multinomial

from madviz.errors import UserError
from madviz.measure.statistics import (
    Paired,
    SuccessRate,
    difference_interval,
    mean_interval,
    pair,
    wilson,
)


@pytest.mark.parametrize("n", [1, 2, 10, 25, 100])
def test_wilson_agrees_with_scipy(n):
    for successes in range(n + 1):
        expected = binomtest(successes, n).proportion_ci(method="wilson")
        assert wilson(successes, n) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_wilson_contains_the_rate_at_the_ends_and_knows_nothing_from_nothing():
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(0, 10)[0] == 0.0 and wilson(10, 10)[1] == 1.0
    assert wilson(10, 10)[0] == pytest.approx(0.722467, abs=1e-6)


@pytest.mark.parametrize(("successes", "n"), [(-1, 10), (11, 10), (1, 0)])
def test_wilson_refuses_impossible_counts(successes, n):
    with pytest.raises(UserError, match="expected 0 <= successes <= n"):
        wilson(successes, n)


def test_a_success_rate_says_its_interval_and_count():
    rate = SuccessRate.of(45, 50)
    assert (rate.value, rate.interval, rate.n) == (0.9, wilson(45, 50), 50)
    assert str(rate) == "0.90 [0.79, 0.96] n=50"
    nothing = SuccessRate.of(0, 0)
    assert nothing == SuccessRate.of(0, 0) and nothing.interval == (0.0, 1.0)
    assert np.isnan(nothing.value)


def from_two_wilson_intervals(first, second, n):
    """Newcombe (1998, first paper, method 10): the difference of rates of independent episodes."""
    p, q = first / n, second / n
    (p_low, p_high), (q_low, q_high) = wilson(first, n), wilson(second, n)
    low = p - q - np.hypot(p - p_low, q_high - q)
    return low, p - q + np.hypot(p_high - p, q - q_low)


@pytest.mark.parametrize("cells", [(0.6, 0.3, 0.05, 0.05), (0.4, 0.2, 0.2, 0.2)])
def test_the_paired_interval_covers_the_truth_about_95_percent_of_the_time(cells):
    n, covered = 20, 0.0
    for both in range(n + 1):
        for first in range(n + 1 - both):
            for second in range(n + 1 - both - first):
                counts = (both, first, second, n - both - first - second)
                low, high = Paired(*counts).interval()
                if low <= cells[1] - cells[2] <= high:
                    covered += multinomial.pmf(counts, n, cells)
    assert 0.93 < covered < 0.99


def test_pairing_narrows_the_interval_of_policies_that_fail_on_the_same_seeds():
    paired = Paired(both=70, first_only=10, second_only=2, neither=18)
    assert paired.difference == pytest.approx(0.08)
    low, high = paired.interval()
    unpaired = from_two_wilson_intervals(80, 72, 100)
    assert low < paired.difference < high
    assert high - low < 0.75 * (unpaired[1] - unpaired[0])


def test_paired_interval_without_association_is_the_unpaired_one():
    paired = Paired(both=25, first_only=25, second_only=25, neither=25)
    assert paired.interval() == pytest.approx(from_two_wilson_intervals(50, 50, 100))
    assert Paired(0, 0, 0, 0).interval() == (-1.0, 1.0)


def test_mcnemar_counts_only_the_episodes_that_differ():
    assert Paired(50, 0, 0, 50).mcnemar() == 1.0
    assert Paired(50, 10, 0, 40).mcnemar() == pytest.approx(2 * 0.5**10)
    assert Paired(0, 10, 0, 0).mcnemar() == Paired(90, 10, 0, 0).mcnemar()


def test_pair_uses_common_seeds_only():
    first = {1: True, 2: True, 3: False, 4: False, 5: True}
    second = {4: False, 3: True, 2: False, 1: True, 6: True}
    assert pair(first, second) == Paired(1, 1, 1, 1)


def test_a_mean_over_subsets_says_more_than_its_seeds_only_where_they_are_independent():
    alike = [1.0] * 80 + [0.0] * 20
    assert mean_interval(alike, 4) == pytest.approx(wilson(80, 100))
    # Independent subsets: four times as many episodes, half the width.
    rng = np.random.default_rng(0)
    shares = list((rng.random((2000, 4)) < 0.8).mean(1))
    low, high = mean_interval(shares, 4)
    mean = sum(shares) / len(shares)
    assert (low, high) == pytest.approx(wilson(round(mean * 8000), 8000), abs=2e-3)
    # Always three of four: no scatter between seeds is no proof of more than the seeds.
    assert mean_interval([0.75] * 100, 4) == pytest.approx(wilson(75, 100))
    assert mean_interval([1.0] * 10, 4) == wilson(10, 10) and mean_interval([], 4) == (0.0, 1.0)
    assert mean_interval([0.0] * 10, 4) == wilson(0, 10)


def test_the_interval_of_a_mean_over_subsets_covers_the_truth():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(400):
        scene = rng.random((60, 1)) < 0.5  # Half of all seeds are hard for every subset.
        shares = (rng.random((60, 4)) < np.where(scene, 0.95, 0.6)).mean(1)
        low, high = mean_interval(list(shares), 4)
        covered += low <= 0.775 <= high
    assert 0.91 < covered / 400 < 0.99


def test_the_interval_of_paired_differences_is_agresti_and_min():
    # 70 both, 10 first only, 2 second only, 18 neither: their formula with 1/2 added to each cell.
    differences = [0.0] * 88 + [1.0] * 10 + [-1.0] * 2
    b, c, n = 10.5, 2.5, 102
    half = 1.959964 * ((b + c) - (b - c) ** 2 / n) ** 0.5 / n
    expected = ((b - c) / n - half, (b - c) / n + half)
    assert difference_interval(differences) == pytest.approx(expected, abs=1e-6)
    low, high = difference_interval([1.0] * 100)
    assert 0.9 < low < high == 1.0
    assert difference_interval([]) == (-1.0, 1.0)
