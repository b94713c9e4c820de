"""Worker processes, priorities, and how much memory the C library holds.

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

HEAPS = 2
"""Heaps that all threads of the page's server share."""
LARGEST_BLOCK = 32 << 20
"""Bytes; glibc takes larger blocks from the system under any setting."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
"""Their numbers in glibc's malloc.h."""


def set_up_worker(niceness: int = 0) -> None:
    """The first call in a worker process: one core, ``niceness``, Ctrl-C left to the parent, and an
    end with the parent. Never raises: an error belongs into a job, whose caller can see it."""
    os.environ["LP_NUM_THREADS"] = "1"
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.nice(niceness)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def lower_thread_priority(niceness: int) -> None:
    """Lets other threads run first when all cores are busy. Only Linux has a niceness for each
    thread: elsewhere nothing happens."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)


def lowest_priority(pid: int) -> None:
    """Process ``pid``, and all that it starts from now on, runs when nothing else wants a core.
    Niceness alone would leave it an eighth of a core that it shares with a thread of niceness 10;
    Linux has a scheduling policy that leaves it next to nothing."""
    os.setpriority(os.PRIO_PROCESS, pid, 19)
    if sys.platform == "linux":
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


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
