"""Lesson 3: MAD's objective in numbers, and the weights of a method."""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.teaching.checks.exercise import call, exercise, expect, number

SINGLES = np.array([1.0, 2.0, 6.0])
"""Losses of the single cameras."""


@exercise(
    "03.loss",
    "write loss(merged, singles, alpha), MAD's objective",
    "Which two losses does alpha weigh against each other?",
    "The single cameras enter as one number: their mean, whatever their number is.",
    "Alpha times the first, plus what is left of one times the second.",
)
def loss(loss: Any) -> None:
    merged = 10.0
    singles = SINGLES
    found = number(call(loss, merged, singles, 1.0), "one number")
    expect(not np.isclose(found, singles.mean()), "alpha and 1 - alpha have changed places")
    expect(np.isclose(found, merged), "with alpha = 1 it has to be the merged loss")
    found = number(call(loss, merged, singles, 0.0))
    expect(not np.isclose(found, singles.sum()), "it has the sum over the cameras, not their mean")
    words = "with alpha = 0 it has to be the mean of the single losses"
    expect(np.isclose(found, singles.mean()), words)
    found = number(call(loss, merged, singles[:2], 0.25))
    expect(np.isclose(found, 0.25 * merged + 0.75 * 1.5), "with two cameras it is wrong")


@exercise(
    "03.weights",
    "set weights to four numbers: of the sum, of First person, of Third A, of Third B",
    "What is alpha for a method that never reads the sum?",
    "Set alpha to that in MAD's objective. What is left of the first term?",
    "The second term is a mean over three cameras, so each has the same share of 1.",
)
def weights(weights: Any) -> None:
    found = np.asarray(weights, float)
    expect(found.shape == (4,), f"expected four numbers, found the shape {found.shape}")
    expect(found[0] == 0, "Singular Only never reads the sum")
    expect(not np.isclose(found.sum(), 3), "they add up to 3; the second term is a mean")
    right = np.allclose(found, [0, 1 / 3, 1 / 3, 1 / 3], atol=0.005)  # Two digits are enough.
    expect(right, "these are not the weights of alpha = 0")
