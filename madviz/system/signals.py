"""SIGTERM stops a command as Ctrl-C does: by an exception, so that whatever it opened is closed.

The problem: by default SIGTERM ends a process where it stands. A page then leaves its simulators,
workers and a training behind, and Python warns of semaphores that nobody freed. That is what
``docker stop``, ``systemctl stop``, ``timeout`` and a batch system send.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from madviz.errors import Terminated


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM raises Terminated in the block; a second one ends the process at once. Outside the
    main thread, where Python takes no signals, nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
