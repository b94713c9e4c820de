"""Lesson 8: a Shapley value by hand, and what "success without it" hides."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations
from typing import Any

import numpy as np

from madviz.teaching.checks.exercise import call, exercise, expect, number

RATES = {"": 0.05, "a": 0.1, "b": 0.3, "c": 0.0, "ab": 0.8, "ac": 0.2, "bc": 0.4, "abc": 1.0}
"""Success by cameras."""


def rate(cameras: Iterable[str]) -> float:
    """The rate of a set of cameras, in any order."""
    return RATES["".join(sorted(cameras))]


@exercise(
    "08.shapley",
    "write shapley(rate, camera, cameras), the mean of what camera adds over all orders",
    "In one order of the cameras, which of them are there before `camera` comes?",
    "What it adds is the rate with it minus the rate without it, of those cameras and no others.",
    "Go over `permutations(cameras)`, cut each order where `camera` is, and average what it adds.",
)
def shapley(shapley: Any) -> None:
    for cameras in ("abc", "ab"):
        for camera in cameras:
            found = number(call(shapley, rate, camera, tuple(cameras)), "one number")
            others = [c for c in cameras if c != camera]
            if cameras == "abc":
                last = rate(cameras) - rate(others)
                words = "this is the rate with all minus the rate without it: one order of six"
                expect(not np.isclose(found, last), words)
                words = "this is the rate of it alone: one order of six"
                expect(not np.isclose(found, rate(camera) - rate("")), words)
            words = f"for {camera!r} of {cameras!r} it is not the mean over all orders"
            expect(np.isclose(found, _mean_over_orders(camera, cameras)), words)


def _mean_over_orders(camera: str, cameras: str) -> float:
    before = [order[: order.index(camera)] for order in permutations(cameras)]
    return float(np.mean([rate((*there, camera)) - rate(there) for there in before]))


@exercise(
    "08.spared",
    "set spared to the camera that can be taken away without a loss of success",
    "Compare the rate of `all` with the rates of the three pairs.",
    "Which pair succeeds as often as `all`? The answer is the camera that is not in it.",
    'Its Shapley value is more than zero all the same. The answer is a name such as "first".',
)
def spared(spared: Any) -> None:
    known = ("first", "third_a", "third_b")
    expect(spared in known, f"expected one of {', '.join(known)}, found {spared!r:.60}")
    expect(spared != "first", "without First person there is no success at all")
    expect(spared != "third_a", "without Third A about a sixth of the episodes fails")
