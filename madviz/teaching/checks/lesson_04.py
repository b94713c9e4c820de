"""Lesson 4: what ten episodes can say about two policies, and a test for a frozen camera."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from madviz.measure.statistics import Paired
from madviz.teaching.checks.exercise import call, exercise, expect, number


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
        counts = (found.both, found.first_only, found.second_only, found.neither)
        expect(min(counts) >= 0, f"{name} has fewer than 0 episodes of a kind")
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


@exercise(
    "04.frozen",
    "write frozen(picture, before, state, state_before), true where two pictures are the same",
    "What does a frozen camera send at this step, compared with the step before?",
    "One number that differs is enough for another picture.",
    "`np.array_equal(a, b)` is true where all numbers are the same.",
)
def frozen(frozen: Any) -> None:
    _finds_frozen(frozen)


@exercise(
    "04.mended",
    "write mended(...) like frozen(...), but with no alarm where the robot stands still",
    "When is an unchanged picture no fault?",
    "Compare `state` with `state_before`, too.",
    "It is frozen where the robot moved *and* the picture is the same.",
)
def mended(mended: Any) -> None:
    _finds_frozen(mended)
    picture = _picture()
    hand = np.array([0.1, 0.6, 0.2], np.float32)
    expect(
        not _answer(mended, picture, picture, hand, hand),
        "it raises an alarm while the robot stands still",
    )


def _finds_frozen(test: Any) -> None:
    picture = _picture()
    hand = np.array([0.1, 0.6, 0.2], np.float32)
    moved = hand + np.float32(0.01)
    for axis in np.eye(3, dtype=np.float32):
        found = _answer(test, picture, picture.copy(), hand + 0.01 * axis, hand)
        words = "it misses a camera whose picture is the same while the hand moved by 1 cm"
        expect(found, f"{words} along {'xyz'[int(axis.argmax())]} alone")
    for other, what in _changed(picture):
        expect(
            not _answer(test, other, picture, moved, hand),
            f"it raises an alarm where {what}",
        )


def _changed(picture: np.ndarray) -> Iterator[tuple[np.ndarray, str]]:
    """Other pictures, each with what has changed: one value of each colour, or two whole pixels
    with different values, which leaves every sum as it was."""
    for colour, place in enumerate((0, 40, 83)):
        other = picture.copy()
        other[place, place, colour] += 1
        yield other, "one pixel of the picture has changed"
    other = picture.copy()
    other[10, [20, 60]] = picture[10, [60, 20]]
    yield other, "two pixels of the picture have changed places"


def _picture() -> np.ndarray:
    return np.random.default_rng(4).integers(0, 200, (84, 84, 3), np.uint8)


def _answer(test: Any, *values: Any) -> bool:
    found = call(test, *values)
    expect(isinstance(found, bool | np.bool_), f"expected True or False, found {found!r:.60}")
    return bool(found)


def _p(tens: int) -> float:
    """McNemar's p in the best case of so many times ten episodes."""
    return Paired(7 * tens, 2 * tens, 0, tens).mcnemar()
