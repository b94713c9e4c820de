"""Garbage collection, which waits while modules are imported.

torch and what it needs are 400,000 objects that stay. Python goes through all of them again
and again while they are made, to find some that may go: a fifth of the time of these imports, 0.4
s on two cores. So collection is off meanwhile. Afterwards they count as old, without being gone
through.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_collection() -> Iterator[None]:
    """Collects no garbage inside; whether it is collected outside stays as it is."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():  # What others have frozen stays so.
            gc.freeze()
            gc.unfreeze()  # To the oldest generation, which is seldom gone through.
        if was_on:
            gc.enable()
