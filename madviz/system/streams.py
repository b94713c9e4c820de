"""Standard output and standard error that are closed, full, or that nobody reads any more.

    madviz list | head -1      the reader has seen enough: no error, the command goes on to its end
    madviz list > /dev/full    the result is lost: one line and exit code 2
    madviz list >&-            as with > /dev/null

Python would print a traceback, or at its end 'Exception ignored', and exit with 1 or 120. And where
a descriptor is closed, the next file that is opened gets its number: what C libraries print would
go into that file.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from madviz.errors import UserError

NOT_WRITTEN = (errno.ENOSPC, errno.EIO, errno.EFBIG, errno.EDQUOT)
"""The errors of a disk that takes no more; Python then names no file."""


def open_standard_streams() -> None:
    """Puts /dev/null where standard input, output or error is closed; called first of all."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # Takes the lowest number that is free.
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w", closefd=False))


@contextmanager
def telling() -> Iterator[None]:
    """Prints the result of a command in the block. If its reader has left, that is no mistake.
    Raises UserError where it can't be written for another reason."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        _give_up(sys.stdout)
    except OSError as error:
        if error.errno not in NOT_WRITTEN:
            raise
        _give_up(sys.stdout)
        raise UserError(
            f"standard output: expected a place that can be written to, found: {error.strerror}; "
            "make room, or send it elsewhere"
        ) from error


def say(line: str) -> None:
    """A line on standard error; where that can't be written, nobody wants to know."""
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:
        _give_up(sys.stderr)


def _give_up(stream: TextIO) -> None:
    """Whatever is left in ``stream``, and whatever comes, goes to /dev/null."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
