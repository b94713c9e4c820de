"""Successes in words, tables and bars: always with their number of episodes and an interval."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from madviz.errors import UserError
from madviz.measure.statistics import SuccessRate, pair
from madviz.policies import checkpoint
from madviz.teaching.names import named
from madviz.teaching.show import Figure, TextTable, Words, bars, table


def in_words(successes: int, n: int) -> Words:
    """``8 of 10 = 0.80, 95% interval [0.49, 0.94]``."""
    rate = SuccessRate.of(successes, n)
    low, high = rate.interval
    return Words(f"{successes} of {n} = {rate.value:.2f}, 95% interval [{low:.2f}, {high:.2f}]")


def counts(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[int, int]]:
    """Subset -> (successes, episodes), from the rows of an evaluation or of evaluation.json."""
    return {name: (round(row["success"] * row["n"]), row["n"]) for name, row in rows.items()}


def shipped(policy: str) -> dict[str, tuple[int, int]]:
    """Subset -> (successes, episodes) of a policy's evaluation.json: measured before, not here.

    Raises UserError where the policy has none.
    """
    found = checkpoint.shipped_evaluation(checkpoint.find_policy(policy))
    if found is None:
        raise UserError(f"{policy}: expected an evaluation.json; make one: madviz eval --card")
    return counts(found["subsets"])


def shipped_outcomes(policy: str, subset: str, development: bool = False) -> dict[int, bool]:
    """Seed -> success of a policy's evaluation.json, for ``statistics.pair``; with ``development``
    of its episodes on development seeds, which begin at 5000."""
    path = checkpoint.find_policy(policy)
    found = checkpoint.shipped_evaluation(path, checkpoint.DEVELOPMENT) if development else None
    found = found or checkpoint.shipped_evaluation(path) or {"episodes": []}
    return {e["seed"]: e["success"] for e in found["episodes"] if e["subset"] == subset}


def success_table(measured: Mapping[str, Mapping[str, tuple[int, int]]]) -> TextTable:
    """A row per subset, and for each of ``measured`` its rate, interval and count."""
    names = dict.fromkeys(name for one in measured.values() for name in one)
    rows = []
    for name in names:
        found = [one.get(name) for one in measured.values()]
        rates = [str(SuccessRate.of(*f)) if f else "not measured" for f in found]
        rows.append([named(name), *rates])
    return table(["cameras", *measured], rows)


def success_bars(title: str, measured: Mapping[str, Mapping[str, tuple[int, int]]]) -> Figure:
    """Success by subset, with Wilson intervals; only subsets that all of ``measured`` have."""
    first, *others = measured.values()
    groups = [name for name in first if all(name in other for other in others)]
    series = {name: [one[group] for group in groups] for name, one in measured.items()}
    return bars(title, [named(group) for group in groups], series)


def paired_table(
    names: tuple[str, str], outcomes: Mapping[str, tuple[Mapping[int, bool], Mapping[int, bool]]]
) -> TextTable:
    """Two policies on the seeds that both have (seed -> success, twice), a row for each subset:
    how often which succeeded, and the difference of their rates with its interval."""
    rows = []
    for subset, (first, second) in outcomes.items():
        paired = pair(first, second)
        low, high = paired.interval()
        difference = f"{paired.difference:+.2f} [{low:+.2f}, {high:+.2f}] n={paired.n}"
        counted = (paired.both, paired.first_only, paired.second_only, paired.neither)
        rows.append([named(subset), *counted, difference])
    only = [f"only {name}" for name in names]
    return table(["cameras", "both", *only, "neither", " - ".join(names)], rows)
