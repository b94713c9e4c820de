"""The formulas behind ``statistics.py``, for one table of counts or for thousands at once.

Two conditions that met the same scenes make one table: both succeed, only the first, only the
second, neither. Every function takes numbers or arrays, which broadcast, and returns arrays.

Worked: 100 scenes, 70 both, 10 first only, 2 second only, 18 neither.

    newcombe(70, 10, 2, 18)    0.80 - 0.72 = +0.08, interval [+0.01, +0.15]
    mcnemar(10, 2)             0.039: 12 scenes differ; a fair coin gives 10 to 2 or worse so often
    holm([0.039, 0.001])       [0.039, 0.002]: the smaller one counts twice, because there are two

Wilson (1927); Newcombe (Statistics in Medicine 1998, second paper, method 10); McNemar (1947),
exact; Holm (1979); Agresti and Min (Statistics in Medicine 2005); Satterthwaite (Biometrics
Bulletin 1946) for Student's t over groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np

from madviz.types import Array

Numbers = Any
"""A number, a list of them or an array."""


def wilson_bounds(successes: Numbers, n: Numbers, confidence: float = 0.95) -> tuple[Array, Array]:
    """Wilson's interval of rates; ``n`` above 0. Counts need not be whole."""
    successes = np.asarray(successes, float)
    n = np.asarray(n, float)
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = successes / n
    shrink = 1 / (1 + z * z / n)
    centre = shrink * (rate + z * z / (2 * n))
    half = shrink * z * np.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # At 0 of n and n of n the bound is exact; rounding must not push it off.
    low = np.where(successes == 0, 0.0, np.maximum(centre - half, 0.0))
    high = np.where(successes == n, 1.0, np.minimum(centre + half, 1.0))
    return low, high


def newcombe(
    both: Numbers,
    first_only: Numbers,
    second_only: Numbers,
    neither: Numbers,
    confidence: float = 0.95,
) -> tuple[Array, Array]:
    """Interval of the difference of two paired rates, first minus second; (-1, 1) where nothing
    was tried. With Newcombe's correction of phi towards 0 for positive association."""
    both, first_only, second_only, neither = (
        np.asarray(count, float) for count in (both, first_only, second_only, neither)
    )
    n = both + first_only + second_only + neither
    tried = np.where(n == 0, 1, n)
    first = both + first_only
    second = both + second_only
    p = first / tried
    q = second / tried
    p_low, p_high = wilson_bounds(first, tried, confidence)
    q_low, q_high = wilson_bounds(second, tried, confidence)
    product = first * (second_only + neither) * second * (first_only + neither)
    association = both * neither - first_only * second_only
    association = np.where(association > 0, np.maximum(association - n / 2, 0), association)
    correlation = np.where(product == 0, 0.0, association / np.sqrt(np.maximum(product, 1.0)))

    def reach(a: Array, b: Array) -> Array:
        return np.sqrt(np.maximum(a * a - 2 * correlation * a * b + b * b, 0.0))

    low = np.maximum(p - q - reach(p - p_low, q_high - q), -1.0)
    high = np.minimum(p - q + reach(p_high - p, q - q_low), 1.0)
    return np.where(n == 0, -1.0, low), np.where(n == 0, 1.0, high)


def mcnemar(first_only: Numbers, second_only: Numbers) -> Array:
    """Exact two-sided p-value of 'both are equally good': the scenes that came out differently must
    then be a fair coin. 1 where none did."""
    from scipy.stats import binom  # Most of a second; whoever only draws a page does without.

    first_only = np.asarray(first_only)
    second_only = np.asarray(second_only)
    fewer = np.minimum(first_only, second_only)
    different = first_only + second_only
    return np.minimum(2 * binom.cdf(fewer, different, 0.5), 1.0)


def mcnemar_any_time(first_only: Numbers, second_only: Numbers) -> Array:
    """A p-value of 'both are equally good' for those who look after every scene: the chance that it
    is ever up to p is at most p. 1 where no scene came out differently.

    The inverse of a likelihood ratio (Robbins, 1970): coins of every bias, each as likely as any
    other, against the fair one. Under a fair coin it is a martingale, which exceeds 20 at any time
    at most 5 times in 100 (Ville's inequality)."""
    from scipy.stats import binom

    first_only = np.asarray(first_only)
    second_only = np.asarray(second_only)
    different = first_only + second_only
    return np.minimum((different + 1) * binom.pmf(first_only, different, 0.5), 1.0)


def holm(p: Numbers) -> Array:
    """Holm's adjusted p-values over the last axis: whoever calls those up to 0.05 significant calls
    any true null hypothesis of the family false at most 5 times in 100, however the tests hang
    together."""
    p = np.asarray(p, float)
    order = np.argsort(p, -1)
    # The smallest p-value counts as often as there are tests, the next one once less, ...
    count = p.shape[-1]
    steps = np.take_along_axis(p, order, -1) * np.arange(count, 0, -1)
    adjusted = np.minimum(np.maximum.accumulate(steps, -1), 1.0)
    result = np.empty_like(p)
    np.put_along_axis(result, order, adjusted, -1)
    return result


def agresti_min(differences: Numbers, confidence: float = 0.95) -> tuple[Array, Array]:
    """Interval of means over the last axis of paired differences, each in [-1, 1]; (-1, 1) where
    nothing was tried.

    The usual interval after adding half a pair to each of the four ways in which two episodes can
    come out together, so that it neither shrinks to nothing where all differences are equal nor
    needs many seeds. Agresti and Min's is for 0, 1 and -1; shares lie between.
    """
    differences = np.asarray(differences, float)
    n = differences.shape[-1] + 2
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    mean = differences.sum(-1) / n
    squares = ((differences**2).sum(-1) + 1) / n
    half = z * np.sqrt(np.maximum(squares - mean**2, 0.0) / n)
    if n == 2:
        return np.full(mean.shape, -1.0), np.full(mean.shape, 1.0)
    return np.maximum(mean - half, -1.0), np.minimum(mean + half, 1.0)


def student(
    groups: Sequence[Sequence[Sequence[float]]], least: float = 0.0, confidence: float = 0.95
) -> tuple[float, float]:
    """Interval of a mean over groups (tasks) of trainings of episodes: Student's t over trainings.

    ``groups[g][k]``: the outcomes of training k in group g, each from ``least`` to 1: shares, or
    differences from -1 on. The groups are the ones of interest; their trainings are a sample. A
    group with one training says nothing of others: its episodes are the sample.

    The interval is formed on the logit scale around the logit of the mean, so that it stays inside
    the range and is longer towards its middle: t * se / (m (1 - m)), the delta method. Degrees of
    freedom are Welch and Satterthwaite's.

    Worked: three trainings with 50 episodes each and rates 0.9, 0.8 and 0.4: mean 0.7, se 0.153,
    t = 4.30, and [0.09, 0.98]. Wilson's of the pooled 105 of 150 is [0.62, 0.77].

    Simulated with 3 and 5 trainings of 50 and 100 episodes, joined with the interval over episodes:
    it covers the mean of trainings 93 to 99 times in 100 for rates from 0.1 to 0.9 that spread
    between trainings by up to 0.13, from 0.3 to 0.8 also by 0.2, and for differences throughout.
    A rate of 0.95 with a spread of 0.1 is covered 79 to 89 times only: most trainings are then
    perfect, and few fail badly.
    """
    from scipy.stats import t  # Most of a second; a caller that only draws a page does without.

    total = sum(len(episodes) for group in groups for episodes in group)
    mean = 0.0
    variances = []
    for group in groups:
        part = sum(map(len, group)) / total
        values = [float(np.mean(episodes)) for episodes in group]
        mean += part * float(np.mean(values))
        sample = values if len(values) > 1 else list(map(float, group[0]))
        spread = float(np.var(sample, ddof=1)) / len(sample) if len(sample) > 1 else 0.0
        variances.append((part**2 * spread, len(sample) - 1))
    variance = sum(value for value, _ in variances)
    if variance == 0:
        return mean, mean
    freedom = variance**2 / sum(value**2 / degrees for value, degrees in variances if value)
    share = (mean - least) / (1 - least)
    error = variance**0.5 / (1 - least)
    half = float(t.ppf(0.5 + confidence / 2, freedom)) * error / (share * (1 - share))
    logit = float(np.log(share / (1 - share)))
    low, high = (1 / (1 + np.exp(-end)) for end in (logit - half, logit + half))
    return float(least + low * (1 - least)), float(least + high * (1 - least))


def detectable(n: int, level: float, chance: float = 0.05, power: float = 0.8) -> float:
    """The smallest difference of two paired rates that McNemar's test finds at ``level`` with
    probability ``power`` in ``n`` scenes; NaN where even the largest is not found so often.

    A removed camera also changes some scenes by chance: ``chance`` of them for the better, and as
    many for the worse, beside those that make the difference. Exact, up to 0.001: D scenes differ,
    of which L are losses, and L must reach what the test asks for at that D.
    """
    from scipy.stats import binom

    different = np.arange(n + 1)
    enough = binom.isf(level / 2, different, 0.5) + 1

    def found(difference: float) -> float:
        share = difference + 2 * chance
        lost = (difference + chance) / share if share else 1.0
        return float((binom.pmf(different, n, share) * binom.sf(enough - 1, different, lost)).sum())

    low = 0.0
    high = 1 - 2 * chance
    if found(high) < power:
        return float("nan")
    while high - low > 0.0005:
        middle = (low + high) / 2
        low, high = (low, middle) if found(middle) >= power else (middle, high)
    return high


def t_interval(values: Array, confidence: float = 0.95) -> tuple[float, float]:
    """Student's t interval of the mean of ``values`` (n,), n from 2 on.

    Of draws from a gamma distribution of shape 2 it covers the mean 94 times in 100 at n = 2 and 92
    times at n = 5; percentiles of bootstrapped means would do so 48 and 84 times.
    """
    from scipy.stats import t  # Most of a second; a caller that only draws a page does without.

    count = len(values)
    wide = float(t.ppf((1 + confidence) / 2, count - 1)) * float(np.std(values, ddof=1))
    mean = float(np.mean(values))
    return mean - wide / count**0.5, mean + wide / count**0.5
