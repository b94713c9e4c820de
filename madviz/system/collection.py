"""Garbage collection, which waits while modules are imported.

torch and what it needs are 400,000 objects that stay. Python goes through all of them again and
again while they are made, to find some that may go: a seventh of the time of these imports, 0.3 s
on two cores. So collection is off meanwhile. Afterwards they count as old without being gone
through; but for child processes, whose frozen objects are shared with others and stay frozen.
"""

from __future__ import annotations

import gc
import sys
from importlib import import_module
from types import ModuleType


def imported(name: str) -> ModuleType:
    """The module ``name``; imported, where it is not yet, without collecting garbage meanwhile.
    Raises what the import raises."""
    if name in sys.modules or not gc.isenabled():
        return import_module(name)
    from multiprocessing import parent_process  # ``madviz --help`` does without.

    gc.disable()
    try:
        return import_module(name)
    finally:
        if parent_process() is None:
            gc.freeze()
            gc.unfreeze()  # To the oldest generation, which is seldom gone through.
        gc.enable()
