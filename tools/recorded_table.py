"""The blocks of docs/own-robot.md: success of policies that learned from recordings, and whether an
audit on recordings predicts it, from results/recorded.csv (``python tools/recorded_chain.py``)."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Collection, Iterable
from math import nan
from typing import NamedTuple

import numpy as np
from measurements import table
from policy_files import LABELS
from recorded_chain import (
    ACT,
    BESIDE,
    COUNT,
    FILM_SEEDS,
    GUARD_SEEDS,
    GUARDED,
    GUARDED_ON_FILMS,
    METHODS,
    ON_FILMS,
    PLAIN,
    SEEDS,
    TABLE,
    WAYS,
    Condition,
    condition_of,
)
from scipy.stats import rankdata

from madviz.measure.audit.recorded import HARDLY
from madviz.measure.statistics import SuccessRate

NAMES = {
    "mad": "MAD",
    "merged-only": "Merged Only",
    "singular-only": "Singular Only",
    ACT: "LeRobot's ACT",
}
COSTS = 0.1
"""A camera costs success where more than this share of the episodes is lost without it."""


class Point(NamedTuple):
    """One camera of one policy, lost in one way."""

    policy: tuple[str, str]
    camera: str
    how: str
    change: float
    """The change of the action, in spreads."""
    lost: int
    """Episodes that succeed with all cameras less those without this one."""


def recorded() -> str:
    """Success of each method under each condition, and what follows from the audit's changes."""
    measured = complete()
    if not any(one.what == "removed" for one in map(condition_of, measured)):
        return "Not every policy was evaluated yet; nothing is said before all are.\n"
    lines = []
    for key in dict.fromkeys(map(_group, measured)):
        ours = [row for row in measured if _group(row) == key]
        rates = [_rate(row for row in ours if row["method"] == method) for method in NAMES]
        lines.append([_words(*key), *rates])
    every = points(measured, SEEDS)
    act = [one for one in every if one.policy[0] == ACT]
    designed = [one for one in every if one not in act]
    said = [*_sentences(designed), *([_of_act(act)] if act else [])]
    return f"{table(['cameras', *NAMES.values()], lines)}\n" + "".join(f"- {s}\n" for s in said)


def films() -> str:
    """The table has the success of each method that learned from LeRobot's own films; a sentence
    says whether the audit's changes predict it."""
    with TABLE.open(newline="") as file:
        measured = [row for row in csv.DictReader(file) if int(row["seed"]) in FILM_SEEDS]
    lines = []
    for one in (*ON_FILMS, *GUARDED_ON_FILMS):
        ours = [row for row in measured if condition_of(row) == one]
        if len(ours) < len(METHODS) * len(FILM_SEEDS):
            return "Not every policy was evaluated yet; nothing is said before all are.\n"
        rates = [_rate(row for row in ours if row["method"] == method) for method in METHODS]
        lines.append([_words(one, guarded=False), *rates])
    dropped = [one for one in points(measured, FILM_SEEDS) if one.how == "dropped"]
    said = _sentence("A dropped camera", dropped)
    return f"{table(['cameras', *(NAMES[one] for one in METHODS)], lines)}\n- {said}\n"


def complete() -> list[dict[str, str]]:
    """The rows of those conditions that both trainings of every method have, in the design's
    order, and ACT's. Those on larger films are apart (``films``)."""
    with TABLE.open(newline="") as file:
        measured = [row for row in csv.DictReader(file) if int(row["seed"]) not in FILM_SEEDS]
    count = Counter(_group(row) for row in measured if row["method"] != ACT)
    kept = [
        row
        for row in measured
        if row["method"] == ACT or count[_group(row)] == len(METHODS) * len(SEEDS)
    ]
    order = [(one, False) for one in PLAIN] + [(one, True) for one in (*BESIDE, *GUARDED)]
    return [row for one in order for row in kept if _group(row) == one]


def _group(row: dict[str, str]) -> tuple[Condition, bool]:
    """The condition, and whether the training is played with the guard, too: one of its own
    weights, or ACT's."""
    condition = condition_of(row)
    return condition, condition.guard or int(row["seed"]) in GUARD_SEEDS


def points(measured: Iterable[dict[str, str]], seeds: Collection[int]) -> list[Point]:
    """Every camera that was lost without the guard, of the policies of these training ``seeds``."""
    kept = [row for row in measured if int(row["seed"]) in seeds]
    intact = {_policy(row): _successes(row) for row in kept if not row["camera"]}
    return [
        Point(
            _policy(row),
            row["camera"],
            row["how"],
            float(row["change"]),
            intact[_policy(row)] - _successes(row),
        )
        for row in kept
        if row["what"] == "removed" and row["guard"] == "False"
    ]


def correlation(some: list[Point]) -> tuple[float, float, float]:
    """Spearman's rank correlation of change and loss, with the interval of Bonett and Wright; NaN
    where one of them never varies."""
    ranks = rankdata([[one.change for one in some], [one.lost for one in some]], axis=1)
    if np.any(ranks.std(axis=1) == 0):
        return nan, nan, nan
    found = float(np.clip(np.corrcoef(ranks)[0, 1], -0.999, 0.999))
    error = np.sqrt((1 + found**2 / 2) / (len(some) - 3))
    low, high = np.tanh(np.arctanh(found) + np.array([-1.96, 1.96]) * error)
    return found, float(low), float(high)


def worst_found(some: list[Point]) -> tuple[int, int]:
    """Two counts of policies and ways: those where the camera with the largest change is one with
    the largest loss, and all in which some camera costs success."""
    found = tried = 0
    for policy, how in sorted({(one.policy, one.how) for one in some}):
        ours = [one for one in some if (one.policy, one.how) == (policy, how)]
        most = max(one.lost for one in ours)
        if most > COSTS * COUNT:
            tried += 1
            found += max(ours, key=lambda one: one.change).lost == most
    return found, tried


def _sentences(every: list[Point]) -> list[str]:
    groups = {f"A {how} camera": [one for one in every if one.how == how] for how in WAYS}
    groups = {name: some for name, some in groups.items() if some} | {"All ways": every}
    return [*(_sentence(name, some) for name, some in groups.items()), _by_limit(every)]


def _sentence(name: str, some: list[Point]) -> str:
    value, low, high = correlation(some)
    right, tried = worst_found(some)
    cases = len({(one.policy, one.how) for one in some})
    return (
        f"{name}: {_verdict(low, high)} (rank correlation {value:.2f} [{low:.2f}, {high:.2f}], "
        f"{len(some)} losses). Some camera costs more than 10 points in {tried} of {cases} "
        f"cases; in {right} of them, the camera with the largest change costs most (by chance, "
        "about a third)."
    )


def _of_act(points_of_act: list[Point]) -> str:
    value, low, high = correlation(points_of_act)
    return (
        f"ACT: {_verdict(low, high)} (rank correlation {value:.2f} [{low:.2f}, {high:.2f}], "
        f"{len(points_of_act)} losses of one training). {_by_limit(points_of_act)}"
    )


def _by_limit(every: list[Point]) -> str:
    """The losses above and below the audit's limit."""
    above = [one.lost for one in every if one.change > HARDLY]
    below = [one.lost for one in every if one.change <= HARDLY]
    costly = [sum(lost > COSTS * COUNT for lost in side) for side in (above, below)]
    most = f"{costly[1]} of {len(below)}, and at most {max(below)} of {COUNT} episodes"
    if not above:
        return f"All lie below the audit's limit of {HARDLY} spreads; above 10 points: {most}."
    return (
        f"Above the audit's limit of {HARDLY} spreads, {costly[0]} of {len(above)} losses are "
        f"above 10 points; below it, {most}."
    )


def _verdict(low: float, high: float) -> str:
    if low > 0:
        return "the larger the change, the larger the loss"
    if high < 0:
        return "the larger the change, the smaller the loss"
    return "the audit on recordings does not predict success"


def _words(key: Condition, guarded: bool) -> str:
    numbers = " and ".join(map(str, GUARD_SEEDS))
    of = ", with the guard" if key.guard else f", trainings {numbers}" if guarded else ""
    if not key.camera:
        return f"all{of}"
    if key.what == "alone":
        return f"{LABELS[key.camera]} alone"
    return f"{LABELS[key.camera]} {key.how}{of}"


def _rate(ours: Iterable[dict[str, str]]) -> str:
    if not (played := "".join(row["at_last_step"] for row in ours)):
        return "not played"
    return str(SuccessRate.of(played.count("1"), len(played)))


def _policy(row: dict[str, str]) -> tuple[str, str]:
    return row["method"], row["seed"]


def _successes(row: dict[str, str]) -> int:
    return row["at_last_step"].count("1")
