"""Lesson 6: what a method loses with a camera, from outcomes that were measured before."""

from __future__ import annotations

from typing import Any

from madviz.teaching.checks.exercise import call, exercise, expect, number
from madviz.teaching.outcomes import counted, one_missing, read_outcomes


@exercise(
    "06.lost",
    "write lost(before, after), the success rate before minus the one after",
    "A digit is an episode, and 1 is a success. How many successes has `before`?",
    "A rate is a number of successes divided by a number of episodes.",
    "Count the digit 1 with `before.count`, divide by the length, and do the same for `after`.",
)
def lost(lost: Any) -> None:
    found = number(call(lost, "1111", "1010"), "one number")
    expect(found != 2, "this is a number of episodes; divide by how many there are")
    expect(found != -0.5, "the sign is reversed: what is lost counts as positive")
    expect(found == 0.5, "for '1111' and '1010' it is wrong")
    found = number(call(lost, "0011", "1111"))
    expect(found == -0.5, "a method that does better without the camera loses less than nothing")
    found = number(call(lost, "1100000000", "0100000000"))
    expect(abs(found - 0.1) < 1e-9, "for ten episodes it is wrong: the rate is of all episodes")


@exercise(
    "06.sturdy",
    "set sturdy to the names of the methods that still succeed in more than half",
    "Which case of `best` has First person missing?",
    "Go over the methods and keep those whose outcomes have enough successes.",
    "Leave out `single`: it has Third A alone, and First person was never its camera.",
)
def sturdy(sturdy: Any) -> None:
    expect(not isinstance(sturdy, str), "expected a list of names, found one name")
    found = set(sturdy)
    measured = counted(one_missing(read_outcomes()), "first missing")
    expect("single" not in found, "`single` has no First person that could be missing")
    unknown = sorted(map(str, found - set(measured)))
    expect(not unknown, f"expected names of methods, found {', '.join(unknown)}")
    for name, (successes, n) in measured.items():
        if name != "single":
            right = 2 * successes > n
            expect(right or name not in found, "one of these fails in half of its episodes or more")
            expect(not right or name in found, "a method is missing")
