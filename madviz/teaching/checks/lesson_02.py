"""Lesson 2: a sum of features, and a mean."""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.teaching.checks.exercise import call, exercise, expect, same, some_cameras

FEATURES = np.array([[1.0, 0.0, 2.0, 4.0], [3.0, 1.0, 0.0, 4.0], [5.0, 0.5, 7.0, 1.0]])
"""Numbers of three cameras."""


@exercise(
    "02.merge",
    "write merge(features, present), the sum of the features of the present cameras",
    "Which rows of `features` belong to cameras that are present?",
    "NumPy takes a row of True and False as an index: it keeps the rows that are True.",
    "Keep the rows of the present cameras, then sum over the axis of the cameras, which is 0.",
)
def merge(merge: Any) -> None:
    everything = np.ones(3, bool)
    same(call(merge, FEATURES, everything), FEATURES.sum(0), "with all cameras it is not the sum")
    for present, where in some_cameras():
        words = f"{where} it is not the sum of those cameras"
        same(call(merge, FEATURES, present), present @ FEATURES, words)
    nothing = call(merge, FEATURES, np.zeros(3, bool))
    same(nothing, np.zeros(4), "with no camera present the result has to be zeros")


@exercise(
    "02.mean",
    "write mean(features, present), the mean over the present cameras",
    "How many cameras are present?",
    "A row of True and False can be summed; divide by that number, not by that of all cameras.",
    "Begin with the sum of exercise 1. With no camera you would divide by zero: divide by 1 then.",
)
def mean(mean: Any) -> None:
    everything = np.ones(3, bool)
    found = call(mean, FEATURES, everything)
    expect(not np.allclose(found, FEATURES.sum(0)), "with all cameras it is the sum, not the mean")
    same(found, FEATURES.mean(0), "with all cameras it is not the mean")
    for present, where in some_cameras():
        words = f"{where} it is not the mean of those cameras"
        same(call(mean, FEATURES, present), FEATURES[present].mean(0), words)
    with np.errstate(all="ignore"):
        nothing = call(mean, FEATURES, np.zeros(3, bool))
    same(nothing, np.zeros(4), "with no camera present the result has to be zeros")
