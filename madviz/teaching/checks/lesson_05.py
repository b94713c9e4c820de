"""Lesson 5: sets of streams, and colour in the dark."""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.teaching.checks.exercise import call, exercise, expect, number

STREAMS = ("first.rgb", "first.depth", "third_a.depth", "third_a.rgb")


@exercise(
    "05.sets",
    "set sets to how many of the 64 sets have depth in them and no colour",
    "From how many streams can such a set be made up?",
    "Each of these streams is in the set or not. How many sets is that?",
    "One of them is empty, and has no depth in it.",
)
def sets(sets: Any) -> None:
    found = number(sets, "a whole number")
    expect(found != 8, "one of these 8 is the empty set, which has no depth")
    expect(found != 3, "these are the single streams; sets of two and three count as well")
    expect(found == 7, f"{found:g} is not their number")


@exercise(
    "05.dark",
    "write dark(stack, streams), a copy in which every colour stream is black",
    "How does the name of a colour stream end?",
    "One row of `stack` belongs to one stream, in the order of `streams`.",
    "Copy the stack first, then set the rows whose name ends so to zero.",
)
def dark(dark: Any) -> None:
    stack = np.arange(1, 4 * 9 * 2 * 2 + 1).reshape(4, 9, 2, 2)
    found = np.asarray(call(dark, stack, STREAMS))
    expect(found.shape == stack.shape, f"expected the shape {stack.shape}, found {found.shape}")
    for row, name in enumerate(STREAMS):
        if name.endswith(".rgb"):
            expect(not found[row].any(), f"{name} is not black")
        else:
            expect(np.array_equal(found[row], stack[row]), f"{name} has changed, and must not")
    given = stack.copy()
    dark(given, STREAMS)
    expect(np.array_equal(given, stack), "it changes the stack that it is given; make a copy")
