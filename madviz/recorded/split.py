"""Which episodes are held out: chosen by number, before any training."""

from __future__ import annotations

from collections.abc import Sequence

EVERY = 10
"""One episode of so many is held out."""


def held_out(indices: Sequence[int]) -> tuple[int, ...]:
    """The episodes that training leaves for validation: every tenth by its index; the last one if
    there is no tenth, and none of a single episode."""
    tenth = tuple(index for index in indices if index % EVERY == EVERY - 1)
    if len(indices) < 2 or len(tenth) == len(indices):
        return tuple(indices[-1:]) if len(indices) > 1 else ()
    return tenth or tuple(indices[-1:])
