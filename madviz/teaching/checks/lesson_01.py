"""Lesson 1: how much a policy gets, and its pictures without motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.teaching.checks.exercise import call, exercise, expect, number, same

CAMERAS = 3
FRAMES = 3
COLOURS = 3
SIDE = 84
STATE = 24
PICTURES = CAMERAS * FRAMES * COLOURS * SIDE * SIDE


@exercise(
    "01.numbers",
    "set numbers to how many numbers the policy gets in one time step",
    "What does the policy get beside pictures?",
    "`now.stack` holds all pictures of all cameras, and every array has a `size`.",
    "Add the size of the pictures to the size of the robot's own state.",
)
def numbers(numbers: Any) -> None:
    found = number(numbers, "a whole number")
    expect(found != PICTURES, "these are the pictures alone; the policy gets something else, too")
    third = PICTURES // CAMERAS  # And the frames of a camera are three as well.
    words = "this is one camera, or one frame of each; there are three of both"
    expect(found not in (third, third + STATE), words)
    expect(found == PICTURES + STATE, f"{found:g} is not what the policy gets; count again")


@exercise(
    "01.still",
    "write still(stack), which has the newest picture three times for every camera",
    "Of the nine channels of a camera, which three are the newest picture?",
    "The oldest frame comes first, so the newest has the last three channels: `stack[:, -3:]`.",
    "`np.concatenate` and `np.tile` repeat a whole block; `np.repeat` repeats every channel alone.",
)
def still(still: Any) -> None:
    stack = np.arange(2 * 9 * 4 * 5).reshape(2, 9, 4, 5)
    found = np.asarray(call(still, stack))
    newest = stack[:, -3:]
    expect(found.shape == stack.shape, f"expected the shape {stack.shape}, found {found.shape}")
    expect(not np.array_equal(found, stack), "nothing has changed")
    oldest = np.array_equal(found, np.tile(stack[:, :3], (1, 3, 1, 1)))
    expect(not oldest, "it has the oldest picture three times, not the newest")
    each = np.array_equal(found, np.repeat(newest, 3, axis=1))
    expect(not each, "the channels are out of order: red three times, then green, then blue")
    same(found, np.tile(newest, (1, 3, 1, 1)), "it is not the newest picture three times")
