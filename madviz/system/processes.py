"""What every worker process does first, before anything heavy is imported; who goes first, and
what memory a server or a training keeps.

OpenGL and PyTorch do not survive a fork, so workers are spawned and load what they need themselves.
Each is meant for one core: Mesa's software renderer would otherwise take them all.
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

ARENAS = 2
"""Heaps that all threads of the page's server share."""
LARGEST_BLOCK = 32 << 20
"""Bytes; glibc takes larger ones from the system whatever it is told."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
"""Their numbers in glibc's malloc.h."""


def set_up_worker(niceness: int = 0) -> None:
    """Must not fail: whatever can go wrong does so inside a job, whose error finds its way back."""
    os.environ["LP_NUM_THREADS"] = "1"
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.nice(niceness)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business.
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def yield_to_others(niceness: int) -> None:
    """Lets other threads go first when all cores are taken; this one gets what is left. Only Linux
    counts niceness by thread: elsewhere nothing happens."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)


def let_all_others_go_first(pid: int) -> None:
    """Process ``pid``, and all that it will start, gets what nobody else wants. Niceness alone
    would leave it an eighth of a core that it shares with ``yield_to_others(10)``; Linux has a
    policy under which it gets next to nothing of it."""
    os.setpriority(os.PRIO_PROCESS, pid, 19)
    if sys.platform == "linux":
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


def share_memory_between_threads() -> None:
    """Bounds what the C library keeps for itself; call it before there are threads. glibc gives
    every thread a heap of its own, up to 16 on two cores, and a page left in each of them by a
    visitor who has gone is memory that the next one does not find."""
    _c_library("mallopt", _M_ARENA_MAX, ARENAS)


def keep_large_blocks() -> None:
    """Lets a training use the memory of one update again for the next. glibc returns large blocks
    to the system as soon as they are free, and a new one is zeroed page by page as it is touched:
    18,700 page faults in an update of the light recipe, a third of its time (118 ms of a core, 78
    without them). It keeps what the largest update needed, some 70 MB more there."""
    _c_library("mallopt", _M_MMAP_THRESHOLD, LARGEST_BLOCK)
    _c_library("mallopt", _M_TRIM_THRESHOLD, 2**31 - 1)


def give_back() -> None:
    """Returns to the system what is not needed any more, where the C library can."""
    gc.collect()
    _c_library("malloc_trim", 0)


def _c_library(function: str, *words: int) -> None:
    """Calls it, unless this is another C library than glibc; those have ways of their own."""
    call = getattr(ctypes.CDLL(None), function, None) if sys.platform == "linux" else None
    if call is not None:
        call(*words)


def _leave_with_parent() -> None:
    """A pool's process waits for jobs for ever, even if the parent was killed; this one leaves."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
