"""A student learns more where it fails: drivers and row weights that follow its failures.

The problem: by default the trained subsets drive in turn, and every single stream has the same
weight in the loss. With soccer, all cameras succeed from the first rounds on, and Third A hardly
ever does; still a quarter of the episodes shows what happens with all of them.

The idea: the share s of a subset is a mix of an even share and of its part of the failures, as they
were counted in the episodes of the last ``ROUNDS`` rounds, each count begun with a success and a
failure, so that an early judgement is no final one:

    s_i = (1 - focus) / K + focus * f_i / sum f,    f_i = (failures + 1) / (episodes + 2)

With focus 0.5 and f = 0.1, 0.1, 0.8, 0.6 the shares are 0.16, 0.16, 0.38, 0.31, and of 8 episodes
1, 1, 3 and 3 are driven on them. The rows of the loss that stand for less than all streams share
their weight in the same way; alpha stays what it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from madviz.types import Array

ROUNDS = 3
"""Rounds whose episodes are counted."""
Outcomes = list[list[tuple[int, bool]]]
"""Round -> of each episode, which subset drove it and whether it succeeded."""


def failures(outcomes: Outcomes, count: int) -> Array:
    """(K,) of each of ``count`` subsets, the share of its latest episodes that failed."""
    lost = np.ones(count)
    driven = np.full(count, 2.0)
    for index, success in (each for found in outcomes[-ROUNDS:] for each in found):
        lost[index] += not success
        driven[index] += 1
    return lost / driven


def shares(failed: Array, focus: float) -> Array:
    """(K,) s, see the module; they add up to 1."""
    return (1 - focus) / len(failed) + focus * failed / failed.sum()


def in_turn(weights: Array, episodes: int, first: int) -> list[int]:
    """Which subset drives each of ``episodes``: as often as ``weights`` (K,) says, rounded so that
    what is left goes to the largest remainders. Equal weights are taken in turn, from the one on
    that episode number ``first`` falls to."""
    exact = weights * episodes
    counts = np.floor(exact + 1e-9).astype(int)
    turn = (np.arange(len(weights)) - first) % len(weights)
    order = np.lexsort((turn, -np.round(exact - counts, 9)))
    counts[order[: episodes - counts.sum()]] += 1
    left = counts.copy()
    chosen = []
    number = first
    while len(chosen) < episodes:
        index = number % len(weights)
        if left[index]:
            chosen.append(index)
            left[index] -= 1
        number += 1
    return chosen


def focused(weights: Array, masks: Array, driven: Sequence[Array], part: Array) -> Array:
    """(N,) the rows' ``weights``, those of rows with less than all streams shared out as ``part``
    (K,) says of the subsets ``driven``; a row that never drives keeps its own."""
    result = weights.copy()
    places = {tuple(mask.tolist()): index for index, mask in enumerate(driven)}
    rows = {
        row: places[tuple(mask.tolist())]
        for row, mask in enumerate(masks)
        if not mask.all() and tuple(mask.tolist()) in places
    }
    if rows:
        mine = list(rows)
        of = list(rows.values())
        result[mine] = weights[mine].sum() * part[of] / part[of].sum()
    return result
