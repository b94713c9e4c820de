"""Who runs first when all cores are busy: a visitor's page, then evaluations, then trainings.

The problem: Linux compares priorities within a *session* only (``setsid``; a terminal window is
one, a browser another). Where all cores are busy, every session gets an equal share of them,
whatever the niceness of its processes (``man 7 sched``, autogroup). An evaluation of niceness 15 in
the server's session is then taken out of the server's share, but the browser beside it is not
served first. A training in a session of its own takes half a core even from a page that waits.

The idea: what may wait gets a session of its own, and the session itself a niceness. Two busy
processes on one core for 4 s (Linux 6.18), in seconds of it:

    an ordinary process beside one that is ...                                 ordinary   other
    in the same session, with the policy for idle times                            3.8     0.5
    in another session, with the policy for idle times                             1.8     2.4
    in another session that has niceness 19, with the policy for idle times        3.4     0.7

Where Linux has no such sessions, or the system is another, niceness does what it can.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

LOWEST = 19
_PAUSE = 0.1
_TRIES = 20
"""Linux takes one change of a session's niceness in so many seconds from all users together."""


def lower_thread_priority(niceness: int) -> None:
    """Lets other threads run first when all cores are busy. Only Linux has a niceness for each
    thread: elsewhere nothing happens."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)


def lower_own_priority(niceness: int) -> None:
    """This process, and all that it starts from now on, becomes nicer by ``niceness``, in a session
    of its own with ``niceness``. It no longer hears Ctrl-C or the end of the terminal."""
    os.nice(niceness)
    if sys.platform == "linux":
        with suppress(PermissionError):  # It leads a group of processes: then its session stays.
            os.setsid()
            _lower_session(os.getpid(), niceness)


def lowest_priority(pid: int) -> None:
    """Process ``pid``, which must have a session of its own, and all that it starts from now on,
    runs when nothing else wants a core."""
    os.setpriority(os.PRIO_PROCESS, pid, LOWEST)
    if sys.platform == "linux":
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))
        _lower_session(pid, LOWEST)


def _lower_session(pid: int, niceness: int) -> None:
    """Sets the priority of the session of ``pid``. Nothing happens where there are no
    autogroups."""
    for _ in range(_TRIES):
        try:
            Path(f"/proc/{pid}/autogroup").write_text(str(niceness))
        except BlockingIOError:
            time.sleep(_PAUSE)
        except OSError:
            return
        else:
            return
