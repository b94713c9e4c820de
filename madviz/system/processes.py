"""Worker processes, whom a process has started, and how much memory the C library holds.

OpenGL and PyTorch do not survive a fork, so workers are spawned and load what they need themselves.
Each is meant for one core: Mesa's software renderer would otherwise take them all.

glibc is configured through ctypes since its environment variables are read before Python starts.
``tests/test_processes.py`` measures what large blocks cost, and kills a parent: its workers, idle
or busy, end within 0.1 s, and without ``set_up_worker`` they never end.
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import signal
import sys
import threading
from multiprocessing.connection import wait
from pathlib import Path

from madviz.system.priority import lower_own_priority

HEAPS = 2
"""Heaps that all threads of the page's server share."""
LARGEST_BLOCK = 32 << 20
"""Bytes; glibc takes larger blocks from the system under any setting."""
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_M_ARENA_MAX = -8
"""Their numbers in glibc's malloc.h."""


def set_up_worker(niceness: int = 0) -> None:
    """The first call in a worker process: one core, Ctrl-C left to the parent, an end with the
    parent and, if ``niceness`` is above 0, a low priority (``priority.py``). Never raises: an error
    belongs into a job, whose caller can see it."""
    os.environ["LP_NUM_THREADS"] = "1"
    os.environ.setdefault("MUJOCO_GL", "egl")
    if niceness > 0:
        lower_own_priority(niceness)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def set_up_worker_of_training() -> None:
    """``set_up_worker``, with SIGTERM left to the parent, too: a service or a batch system sends it
    to all processes, and the training first finishes and saves what its workers are at."""
    set_up_worker()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def family(pid: int) -> list[int]:
    """``pid`` and all processes under it that live; without /proc, ``pid`` alone."""
    found = [pid]
    for one in found:
        try:
            for task in Path(f"/proc/{one}/task").iterdir():
                found += map(int, (task / "children").read_text().split())
        except OSError:  # It ended meanwhile.
            continue
    return found


def limit_heaps() -> None:
    """Bounds how many heaps the C library makes; call it before there are threads. glibc gives
    every thread its own, up to 16 on two cores, and what the thread of one visitor frees there
    cannot be used by the thread of the next."""
    _c_library("mallopt", _M_ARENA_MAX, HEAPS)


def reuse_large_blocks() -> None:
    """Lets a training use the memory of one update again for the next. glibc returns large blocks
    to the system as soon as they are free, and a new one is zeroed page by page as it is touched:
    18,700 page faults in an update of the light recipe, a third of its time (118 ms of a core, 78
    without them). The process stays as large as its largest update, some 70 MB more there."""
    _c_library("mallopt", _M_MMAP_THRESHOLD, LARGEST_BLOCK)
    _c_library("mallopt", _M_TRIM_THRESHOLD, 2**31 - 1)


def release_memory() -> None:
    """Returns free memory to the system, where the C library can."""
    gc.collect()
    _c_library("malloc_trim", 0)


def _c_library(function: str, *words: int) -> None:
    """Calls a function of glibc; with another C library, nothing happens."""
    call = getattr(ctypes.CDLL(None), function, None) if sys.platform == "linux" else None
    if call is not None:
        call(*words)


def _end_with_parent() -> None:
    """A worker waits for its next job for ever, also when its parent was killed; this ends it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
