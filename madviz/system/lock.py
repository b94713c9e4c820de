"""An advisory lock of the operating system: one process at a time works in a folder."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def locked(file: Path) -> Iterator[int | None]:
    """The descriptor of ``file``, locked; None if another process holds it. Makes the file. A
    child process that inherits the descriptor holds the lock, too."""
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield None
        else:
            yield descriptor if _is(descriptor, file) else None
    finally:
        # Closed, not unlocked: a child that runs longer than this process still holds it.
        os.close(descriptor)


def _is(descriptor: int, file: Path) -> bool:
    """Whether ``file`` is what was opened: the process before may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(file))
    except FileNotFoundError:
        return False
