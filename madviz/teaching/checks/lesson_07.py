"""Lesson 7: two merges by hand, a mean of actions and shares of attention."""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.teaching.checks.exercise import call, exercise, expect, same, some_cameras

ACTIONS = np.array([[0.9, -0.2], [-0.5, 0.1], [0.3, 0.7]])
SCORES = np.array([2.0, -1.0, 0.5])
"""Numbers of three cameras."""


@exercise(
    "07.mean_action",
    "write mean_action(actions, present), Q-mean's action",
    "Are the actions averaged as they are, or before something is done to them?",
    "`np.arctanh` undoes `np.tanh`: it gives back the numbers before they were squashed.",
    "Take the rows that are present, undo tanh, take the mean over the cameras, and squash it.",
)
def mean_action(mean_action: Any) -> None:
    for present, where in some_cameras():
        found = np.asarray(call(mean_action, ACTIONS, present), float)
        kept = ACTIONS[present]
        expect(found.shape == (2,), f"{where} expected two numbers, found {found.shape}")
        plain = np.allclose(found, kept.mean(0)) and present.sum() > 1
        expect(not plain, "it is the mean of the squashed actions; Q-mean averages before tanh")
        everyone = np.allclose(found, np.tanh(np.arctanh(ACTIONS).mean(0)))
        expect(present.all() or not everyone, f"{where} the missing cameras are averaged, too")
        same(found, np.tanh(np.arctanh(kept).mean(0)), f"{where} the action is wrong")


@exercise(
    "07.shares",
    "write shares(scores, present), softmax over the cameras that are present",
    "What do the shares of the present cameras add up to?",
    "Softmax is `exp(score)` divided by a sum of such numbers. Over which cameras is that sum?",
    "Take `exp` of all scores, set those of missing cameras to zero, and divide at the end.",
)
def shares(shares: Any) -> None:
    for present, where in some_cameras():
        found = np.asarray(call(shares, SCORES, present), float)
        expect(found.shape == (3,), f"{where} expected three shares, found {found.shape}")
        expect(not found[~present].any(), f"{where} a missing camera has a share")
        total = found.sum()
        expect(np.isclose(total, 1), f"{where} the shares add up to {total:.2f}, not to 1")
        weights = np.exp(SCORES) * present
        same(found, weights / weights.sum(), f"{where} the shares are not softmax")
