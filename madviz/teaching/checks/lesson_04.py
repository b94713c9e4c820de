"""Lesson 4: what ten episodes can say about two policies."""

from __future__ import annotations

from typing import Any

from madviz.measure.statistics import Paired
from madviz.teaching.checks.exercise import exercise, expect, number


@exercise(
    "04.paired",
    "set best and worst to a Paired each: A solved 9 of ten episodes, B 7 of the same",
    "A's successes are `both` and `first_only` together. What are B's?",
    "Best for A: B solves nothing that A does not. Worst for A: no episode that both fail.",
    "Begin with the number that is 0 in each case; the other three follow from 9, 7 and 10.",
)
def paired(best: Any, worst: Any) -> None:
    for name, found in (("best", best), ("worst", worst)):
        expect(isinstance(found, Paired), f"expected {name} to be a Paired, found {found!r:.60}")
        expect(found.n == 10, f"{name} has {found.n} episodes, not 10")
        expect(found.both + found.first_only == 9, f"in {name} A does not solve 9")
        expect(found.both + found.second_only == 7, f"in {name} B does not solve 7")
    expect(best != worst, "best and worst are the same case")
    # With these sums there are two cases and no others.
    expect(best.second_only == 0, "best: B still solves an episode that A fails")


@exercise(
    "04.episodes",
    "set episodes to the smallest multiple of ten whose best case has p below 0.05",
    "Which of the four numbers of a Paired grow when the number of episodes doubles?",
    "Try 20: `Paired(both=14, first_only=4, second_only=0, neither=2).mcnemar()`.",
    "Go on in steps of ten, all four numbers in proportion, until p is below 0.05.",
)
def episodes(episodes: Any) -> None:
    found = number(episodes, "a number of episodes")
    tens = found / 10
    expect(tens == round(tens) and tens > 0, f"{found:g} is not a multiple of ten")
    expect(_p(round(tens)) < 0.05, f"with {found:g} episodes p is {_p(round(tens)):.2g}")
    expect(_p(round(tens) - 1) >= 0.05, f"{found:g} are enough, but fewer are enough, too")


def _p(tens: int) -> float:
    """McNemar's p in the best case of so many times ten episodes."""
    return Paired(7 * tens, 2 * tens, 0, tens).mcnemar()
