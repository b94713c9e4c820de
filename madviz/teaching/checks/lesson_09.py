"""Lesson 9: a plan that is written before the experiment, and a verdict on each expectation."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral
from typing import Any

from madviz.policies.seeds import FIRST_DEVELOPMENT, FIRST_LIVE
from madviz.teaching.checks.exercise import Blank, blank, call, exercise, expect

PARTS = ("question", "conditions", "episodes", "first_seed", "expect", "wrong_if")
LIVE_SEEDS = range(FIRST_LIVE, FIRST_DEVELOPMENT)
FEWEST = 5
BUDGET = 24
"""Episodes of each condition at least; of all together at most, for two minutes of computing."""
WIDEST = 0.6
"""An expectation is narrower than that, or nearly any result agrees with it."""
WORDS = 5
"""Words of a sentence, at least."""


@exercise(
    "09.plan",
    "fill in the plan, before anything is run",
    "What will you change, and what stays as it is? One condition changes nothing at all.",
    "What do you expect in each condition? Write a lowest and a highest rate, less than 0.6 apart.",
    "`wrong_if` says which result would show that you are wrong. Which one would?",
)
def plan(plan: Any) -> None:
    expect(isinstance(plan, Mapping), f"expected a dict, found {plan!r:.60}")
    lacking = [part for part in PARTS if part not in plan]
    expect(not lacking, f"the plan has no {', '.join(lacking)}")
    empty = [part for part in PARTS if blank(plan[part]) or plan[part] == {}]
    if len(empty) == len(PARTS):
        raise Blank
    expect(not empty, f"nothing is written for {', '.join(empty)}")
    for part in ("question", "wrong_if"):
        expect(len(str(plan[part]).split()) >= WORDS, f"{part} has to be a sentence")
    conditions = plan["conditions"]
    _conditions(conditions)
    for part in ("episodes", "first_seed"):
        found = plan[part]
        expect(isinstance(found, Integral), f"expected a whole number for {part}, found {found!r}")
    _size(plan["episodes"], len(conditions))
    seed = plan["first_seed"]
    words = f"seeds of the live page are {LIVE_SEEDS.start} to {LIVE_SEEDS.stop - 1}"
    every = seed in LIVE_SEEDS and seed + plan["episodes"] - 1 in LIVE_SEEDS
    expect(every, f"{words}; others are used for training and for reports")
    _expectations(plan["expect"], conditions)


def _conditions(conditions: Any) -> None:
    expect(isinstance(conditions, Mapping), "expected conditions to be a dict")
    steps = list(conditions.values())
    expect(None in steps, "no condition leaves all cameras on: with what will you compare?")
    dropped = {step for step in steps if step is not None}
    expect(len(dropped) >= 2, "expected First person to be dropped at two different steps or more")
    expect(len(steps) == len(dropped) + 1, "two conditions are the same")
    ok = all(isinstance(step, int) and 0 <= step < 100 for step in dropped)
    expect(ok, "expected steps from 0 to 99: an episode has 100 decisions")


def _size(episodes: float, conditions: int) -> None:
    expect(episodes >= FEWEST, f"with {episodes:g} episodes the intervals say next to nothing")
    total = episodes * conditions
    words = f"{total:g} episodes in all take too long for a lesson; at most {BUDGET}"
    expect(total <= BUDGET, words)


def _expectations(expected: Any, conditions: Mapping[str, Any]) -> None:
    expect(isinstance(expected, Mapping), "expected expect to be a dict")
    for name in conditions:
        expect(name in expected, f"nothing is expected of {name!r}")
        low, high = expected[name]
        expect(0 <= low < high <= 1, f"{name!r}: expected (lowest, highest) between 0 and 1")
        words = f"{name!r}: nearly any result agrees with {low} to {high}; say more"
        expect(high - low < WIDEST, words)
    distinct = {tuple(expected[name]) for name in conditions}
    expect(len(distinct) > 1, "you expect the same everywhere; then what does the step change?")


@exercise(
    "09.verdict",
    "write verdict(expected, interval): as planned, not as planned, or cannot say",
    "When does every rate in the measured interval agree with the plan?",
    "When does no rate in the interval agree with it? All other cases are the third one.",
    "Compare the ends: the interval's lower end with `low`, and its upper end with `high`.",
)
def verdict(verdict: Any) -> None:
    cases = {
        ((0.5, 1.0), (0.6, 0.9)): "as planned",
        ((0.0, 0.5), (0.0, 0.4)): "as planned",
        ((0.6, 1.0), (0.68, 1.0)): "as planned",
        ((0.5, 1.0), (0.1, 0.4)): "not as planned",
        ((0.0, 0.3), (0.4, 0.9)): "not as planned",
        ((0.5, 1.0), (0.4, 0.9)): "cannot say",
        ((0.0, 0.5), (0.3, 0.8)): "cannot say",
        ((0.4, 0.6), (0.1, 0.9)): "cannot say",
    }
    for (expected, interval), right in cases.items():
        found = call(verdict, expected, interval)
        known = sorted(set(cases.values()))
        expect(found in known, f"expected one of {', '.join(known)}, found {found!r:.60}")
        low, high = interval
        where = f"expected {expected[0]} to {expected[1]}, measured [{low}, {high}]"
        expect(found == right, f"{where}: {found!r} is not right")
