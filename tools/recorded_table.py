"""The block of docs/own-robot.md: success of policies that learned from recordings, and whether an
audit on recordings predicts it, from results/recorded.csv (``python tools/recorded_chain.py``)."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from measurements import table
from policy_files import LABELS
from recorded_chain import METHODS, SEEDS, TABLE
from scipy.stats import rankdata

from madviz.measure.statistics import SuccessRate

NAMES = {"mad": "MAD", "merged-only": "Merged Only", "singular-only": "Singular Only"}
WAYS = ("dropped", "black", "frozen")
COSTS = 0.1
"""A camera costs success where more than this is lost without it."""


class Point(NamedTuple):
    """One camera of one policy, lost in one way."""

    policy: tuple[str, str]
    camera: str
    how: str
    change: float
    """Of the action, in spreads."""
    loss: float
    """Of success, at most 1."""


def rows() -> list[dict[str, str]]:
    """What was measured."""
    with TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


def recorded() -> str:
    """Success of each method under each condition, and what follows from the audit's changes."""
    measured = complete(rows())
    methods = list(dict.fromkeys(row["method"] for row in measured))
    lines = []
    for key in dict.fromkeys(_key(row) for row in measured):
        rates = [_rate(measured, method, key) for method in methods]
        lines.append([_words(key), *rates])
    header = ["cameras", *(NAMES[method] for method in methods)]
    return f"{table(header, lines)}\n{_sentences(points(measured))}\n"


def complete(measured: list[dict[str, str]]) -> list[dict[str, str]]:
    """The rows of those conditions that every policy has."""
    count = Counter(_key(row) for row in measured)
    return [row for row in measured if count[_key(row)] == len(METHODS) * len(SEEDS)]


def points(measured: Iterable[dict[str, str]]) -> list[Point]:
    """Every camera of every policy, without the guard, in each way in which it was lost."""
    kept = list(measured)
    intact = {_policy(row): _successes(row).mean() for row in kept if not row["camera"]}
    return [
        Point(
            _policy(row),
            row["camera"],
            row["how"],
            float(row["change"]),
            float(intact[_policy(row)] - _successes(row).mean()),
        )
        for row in kept
        if row["what"] == "removed" and row["guard"] == "False"
    ]


def correlation(some: list[Point]) -> tuple[float, float, float]:
    """Spearman's rank correlation of change and loss, with the interval of Bonett and Wright."""
    ranks = rankdata([[one.change for one in some], [one.loss for one in some]], axis=1)
    found = float(np.corrcoef(ranks)[0, 1])
    error = np.sqrt((1 + found**2 / 2) / (len(some) - 3))
    low, high = np.tanh(np.arctanh(found) + np.array([-1.96, 1.96]) * error)
    return found, float(low), float(high)


def worst_found(some: list[Point]) -> tuple[int, int]:
    """In how many policies and ways the camera with the largest change is one with the largest
    loss, and in how many some camera costs success."""
    found = tried = 0
    for policy, how in sorted({(one.policy, one.how) for one in some}):
        ours = [one for one in some if (one.policy, one.how) == (policy, how)]
        most = max(one.loss for one in ours)
        if most > COSTS:
            tried += 1
            found += max(ours, key=lambda one: one.change).loss == most
    return found, tried


def _sentences(every: list[Point]) -> str:
    groups = {f"A {how} camera": [one for one in every if one.how == how] for how in WAYS}
    groups = {name: some for name, some in groups.items() if some} | {"All ways": every}
    if not every:
        return "Not every policy was evaluated yet."
    lines = []
    for name, some in groups.items():
        value, low, high = correlation(some)
        right, tried = worst_found(some)
        shown = "the larger the change, the larger the loss" if low > 0 else "no relation is shown"
        lines.append(
            f"{name}: {shown} (rank correlation {value:.2f} [{low:.2f}, {high:.2f}], {len(some)} "
            f"points). Where some camera costs more than 10 points, the one with the largest "
            f"change costs most in {right} of {tried} policies."
        )
    return "\n".join(f"- {line}" for line in lines)


def _words(key: tuple[str, str, str, bool]) -> str:
    camera, what, how, guard = key
    if not camera:
        return "all"
    if what == "alone":
        return f"{LABELS[camera]} alone"
    return f"{LABELS[camera]} {how}{', with the guard' if guard else ''}"


def _rate(measured: Iterable[dict[str, str]], method: str, key: tuple) -> str:
    ours = [row for row in measured if row["method"] == method and _key(row) == key]
    played = np.concatenate([_successes(row) for row in ours]) if ours else np.zeros(0)
    return str(SuccessRate.counted(played.astype(bool))) if len(played) else "–"


def _key(row: dict[str, str]) -> tuple[str, str, str, bool]:
    return row["camera"], row["what"], row["how"], row["guard"] == "True"


def _policy(row: dict[str, str]) -> tuple[str, str]:
    return row["method"], row["seed"]


def _successes(row: dict[str, str]) -> np.ndarray:
    return np.array([int(digit) for digit in row["at_last_step"]])
