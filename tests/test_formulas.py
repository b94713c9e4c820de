"""Formulas of paired comparisons against independent computations: scipy, brute force, chance."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import expit, logit
from scipy.stats import binomtest, norm, t

from madviz.measure.formulas import (
    agresti_min,
    detectable,
    holm,
    mcnemar,
    mcnemar_any_time,
    newcombe,
    student,
    wilson_bounds,
)
from madviz.measure.statistics import interval_over_trainings


def test_wilson_takes_arrays_and_agrees_with_scipy():
    successes, n = np.arange(26), np.full(26, 25)
    low, high = wilson_bounds(successes, n, 0.995)
    for k in range(26):
        expected = binomtest(k, 25).proportion_ci(0.995, method="wilson")
        assert (low[k], high[k]) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_mcnemar_is_the_exact_binomial_test():
    first, second = np.meshgrid(np.arange(12), np.arange(12))
    p = mcnemar(first, second)
    for b, c, found in zip(first.ravel(), second.ravel(), p.ravel(), strict=True):
        expected = binomtest(int(b), int(b + c)).pvalue if b + c else 1.0
        assert found == pytest.approx(expected, abs=1e-12)


def test_mcnemar_for_those_who_look_all_the_time_weighs_coins_of_every_bias():
    for first, second in ((0, 0), (1, 0), (3, 3), (8, 0), (2, 11), (40, 60)):
        ratio = quad(lambda c, a=first, b=second: (2 * c) ** a * (2 - 2 * c) ** b, 0, 1)[0]
        assert mcnemar_any_time(first, second) == pytest.approx(min(1 / ratio, 1.0), rel=1e-6)
        assert mcnemar_any_time(second, first) == pytest.approx(1 / max(ratio, 1.0), rel=1e-6)
        assert mcnemar_any_time(first, second) >= mcnemar(first, second)


@pytest.mark.parametrize("differing", [0.1, 0.3, 1.0])
def test_two_equal_sides_are_seldom_called_different_however_often_somebody_looks(differing):
    rng = np.random.default_rng(0)
    differs = rng.random((1000, 400)) < differing
    first_wins = differs & (rng.random((1000, 400)) < 0.5)
    first, all_ = first_wins.cumsum(1), differs.cumsum(1)
    assert (mcnemar(first, all_ - first) <= 0.05).any(1).mean() > 0.1, "a look after every pair"
    assert (mcnemar_any_time(first, all_ - first) <= 0.05).any(1).mean() <= 0.05


def holm_by_hand(p):
    """From the definition: the smallest counts as often as there are, the next once less."""
    result, worst = [0.0] * len(p), 0.0
    for rank, index in enumerate(sorted(range(len(p)), key=lambda i: p[i])):
        worst = max(worst, (len(p) - rank) * p[index])
        result[index] = min(worst, 1.0)
    return result


def test_holm_is_its_definition_and_knows_the_textbook_example():
    rng = np.random.default_rng(0)
    p = rng.random((200, 6)) ** 3
    assert holm(p) == pytest.approx(np.array([holm_by_hand(list(row)) for row in p]))
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def newcombe_by_hand(e, f, g, h, z):
    """Newcombe's own letters: e both, f first only, g second only, h neither; plain numbers."""

    def wilson(count, n):
        middle, spread = 2 * count + z * z, z * (z * z + 4 * count * (n - count) / n) ** 0.5
        return (middle - spread) / (2 * (n + z * z)), (middle + spread) / (2 * (n + z * z))

    n = e + f + g + h
    (l2, u2), (l3, u3) = wilson(e + f, n), wilson(e + g, n)
    p2, p3 = (e + f) / n, (e + g) / n
    below = (e + f) * (g + h) * (e + g) * (f + h)
    above = e * h - f * g
    above = max(above - n / 2, 0) if above > 0 else above
    phi = above / below**0.5 if below else 0.0
    dl2, du2, dl3, du3 = p2 - l2, u2 - p2, p3 - l3, u3 - p3
    delta = (dl2**2 - 2 * phi * dl2 * du3 + du3**2) ** 0.5
    epsilon = (du2**2 - 2 * phi * du2 * dl3 + dl3**2) ** 0.5
    return p2 - p3 - delta, p2 - p3 + epsilon


@pytest.mark.parametrize("confidence", [0.95, 0.995])
def test_newcombe_agrees_with_the_paper_written_down_once_more(confidence):
    z = float(norm.isf((1 - confidence) / 2))
    counts = np.random.default_rng(1).multinomial(60, (0.5, 0.2, 0.1, 0.2), 100)
    counts = np.vstack([counts, [[60, 0, 0, 0], [0, 60, 0, 0], [0, 0, 0, 60], [30, 30, 0, 0]]])
    low, high = newcombe(counts[:, 0], counts[:, 1], counts[:, 2], counts[:, 3], confidence)
    for (both, first, second, neither), *found in zip(counts, low, high, strict=True):
        expected = np.clip(newcombe_by_hand(both, first, second, neither, z), -1, 1)
        assert found == pytest.approx(list(expected), abs=1e-9)
    assert [float(end) for end in newcombe(0, 0, 0, 0)] == [-1.0, 1.0]


def test_newcombe_has_its_published_value():
    # Newcombe (1998), second paper, table II, row a: 36 both, 12 first only, 2 second only, none
    # neither; method 10 gives 0.0569 to 0.3404 for the difference 0.2.
    assert [float(end) for end in newcombe(36, 12, 2, 0)] == pytest.approx(
        [0.0569, 0.3404], abs=5e-5
    )


def test_agresti_and_min_take_many_means_at_once():
    differences = np.random.default_rng(2).choice([-1.0, 0.0, 1.0], (50, 40))
    low, high = agresti_min(differences)
    for row, *ends in zip(differences, low, high, strict=True):
        c, b = np.sum(row > 0) + 0.5, np.sum(row < 0) + 0.5
        n = len(row) + 2
        half = 1.959963985 * (b + c - (c - b) ** 2 / n) ** 0.5 / n
        assert ends == pytest.approx([(c - b) / n - half, (c - b) / n + half], abs=1e-8)
    assert [float(end) for end in agresti_min([])] == [-1.0, 1.0]


@pytest.mark.parametrize(("n", "chance"), [(50, 0.0), (100, 0.05), (400, 0.1)])
def test_what_can_be_detected_is_found_8_times_in_10(n, chance):
    level, rng = 0.035 / 6, np.random.default_rng(3)
    difference = detectable(n, level, chance)
    cells = (chance + difference, chance, 1 - 2 * chance - difference)
    lost, won, _ = rng.multinomial(n, cells, 20_000).T
    found = ((mcnemar(lost, won) <= level) & (lost > won)).mean()
    assert 0.79 < found < 0.82
    assert detectable(4 * n, level, chance) < difference


def test_with_few_episodes_nothing_can_be_detected():
    assert np.isnan(detectable(6, 0.005))
    assert not np.isnan(detectable(20, 0.005))


def test_the_interval_over_trainings_is_students_around_the_logit_of_the_mean():
    # Rates 0.6, 0.7, 0.8: mean 0.7, standard error 0.1 / sqrt(3), t(0.975, 2) = 4.302653.
    half = 4.302653 * 0.1 / 3**0.5 / (0.7 * 0.3)
    expected = [expit(logit(0.7) + sign * half) for sign in (-1, 1)]
    assert student([[[0.6], [0.7], [0.8]]]) == pytest.approx(expected, abs=1e-6)
    # The same as differences: from -1 to 1 is twice as far.
    twice = student([[[0.2], [0.4], [0.6]]], least=-1.0)
    assert twice == pytest.approx([2 * end - 1 for end in expected], abs=1e-6)


def test_groups_count_by_their_episodes_and_one_training_by_its_own():
    first = [[1.0, 0.0] * 10, [1.0] * 15 + [0.0] * 5]  # Rates 0.5 and 0.75 of 20 each.
    lone = [1.0] * 8 + [0.0] * 2
    variance = (0.8**2 * 0.125**2, 0.2**2 * 0.16 / 9)  # Of the means; 0.16 / 9 has n - 1.
    freedom = sum(variance) ** 2 / (variance[0] ** 2 / 1 + variance[1] ** 2 / 9)
    mean = 0.8 * 0.625 + 0.2 * 0.8
    half = t.ppf(0.975, freedom) * sum(variance) ** 0.5 / (mean * (1 - mean))
    expected = [expit(logit(mean) + sign * half) for sign in (-1, 1)]
    assert student([first, [lone]]) == pytest.approx(expected, abs=1e-9)


def test_trainings_that_agree_have_the_interval_of_their_episodes():
    assert student([[[1.0] * 5, [1.0] * 5]]) == (1.0, 1.0)
    assert interval_over_trainings([[[1.0] * 5, [1.0] * 5]], (0.7, 1.0)) == (0.7, 1.0)


@pytest.mark.parametrize("trainings", [3, 5])
@pytest.mark.parametrize(
    ("rate", "spread"), [(0.9, 0.05), (0.9, 0.1), (0.7, 0.1), (0.5, 0.2), (0.8, 0.2)]
)
def test_an_interval_over_trainings_covers_their_mean_as_promised(trainings, rate, spread):
    """Rates of trainings scatter; the interval over their episodes alone covers it too rarely."""
    rng = np.random.default_rng(5)
    size = rate * (1 - rate) / spread**2 - 1  # Of the Beta distribution with this spread.
    covered = 0
    pooled = 0
    audits = 600
    for _ in range(audits):
        rates = rng.beta(rate * size, (1 - rate) * size, trainings)
        outcomes = [(rng.random(50) < one).astype(float) for one in rates]
        episodes = wilson_bounds(sum(map(sum, outcomes)), 50 * trainings)
        low, high = interval_over_trainings([outcomes], (float(episodes[0]), float(episodes[1])))
        covered += low <= rate <= high
        pooled += bool(episodes[0] <= rate <= episodes[1])
    noise = 2.33 * (0.93 * 0.07 / audits) ** 0.5
    assert covered / audits >= 0.93 - noise
    assert spread < 0.1 or pooled / audits < 0.85


@pytest.mark.parametrize("trainings", [3, 5])
def test_an_interval_of_a_difference_over_trainings_covers_it_as_promised(trainings):
    rng = np.random.default_rng(6)
    covered = 0
    for _ in range(600):
        first = rng.binomial(50, np.clip(rng.normal(0.8, 0.1, trainings), 0, 1)) / 50
        second = rng.binomial(50, np.clip(rng.normal(0.5, 0.2, trainings), 0, 1)) / 50
        low, high = student([[[gap] for gap in first - second]], least=-1.0)
        covered += low <= 0.3 <= high
    assert covered / 600 >= 0.93 - 2.33 * (0.93 * 0.07 / 600) ** 0.5
