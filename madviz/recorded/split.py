"""Which episodes are held out: chosen by number, before any training."""

from __future__ import annotations

from collections.abc import Sequence

EVERY = (10, 5, 3)
"""One episode of so many is held out; more of them where that leaves fewer than ``FEWEST``."""
FEWEST = 2
"""Episodes held out, of twice as many: one alone has no interval."""


def held_out(indices: Sequence[int]) -> tuple[int, ...]:
    """The episodes that training leaves for validation: every tenth by its index, every fifth or
    third where that would be one alone; else the last one, and none of a single episode."""
    for every in EVERY:
        found = tuple(index for index in indices if index % every == every - 1)
        if FEWEST <= len(found) <= len(indices) // 2:
            return found
    return tuple(indices[-1:]) if len(indices) > 1 else ()
