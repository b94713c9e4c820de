"""The error for a user's own mistake, and what it says about names."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

TRACEBACK = "Traceback (most recent call last):"
LONGEST = 3000
"""Characters of a message: lists of names need hundreds."""


class UserError(ValueError):
    """A mistake the user can fix, in one line: what was expected, what was found, what next. What
    was found may be anything; what cannot be printed is spelled out, and no word is endless."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class CannotAct(UserError):
    """A policy lacks a camera that it needs."""


class WithResult(UserError):
    """A mistake or mishap after which there is a ``result`` all the same."""

    def __init__(self, message: str, result: Any) -> None:
        super().__init__(message)
        self.result = result


class NotWritten(WithResult):
    """A result that is there, but could not be written where it was wanted."""


class Unfinished(WithResult):
    """Work that stopped on the way; ``result`` is what was finished."""


@contextmanager
def saving(result: Any, what: str) -> Iterator[None]:
    """Whoever writes ``result`` in the block does not lose it: a disk that is full meanwhile raises
    NotWritten, which carries it."""
    try:
        yield
    except (OSError, UserError) as error:
        why = isinstance(error, OSError) and error.strerror or error
        raise NotWritten(
            f"{what} could not be written: {why}; what was measured is printed here, copy it",
            result,
        ) from error


class Terminated(KeyboardInterrupt):
    """A SIGTERM: whatever stops and tidies up at Ctrl-C does so here, too."""


class Interrupted(KeyboardInterrupt):
    """Work was stopped by a signal; the message says how it goes on."""

    def __init__(self, command: str, number: int) -> None:
        """``command`` goes on with it; '' where it had not begun. ``number``: of the signal."""
        super().__init__(
            f"resume with: {command}" if command else "it had not begun, so nothing is lost"
        )
        self.exit_code = 128 + number


def signal_of(stopped: KeyboardInterrupt) -> int:
    """The number of the signal behind it."""
    return signal.SIGTERM if isinstance(stopped, Terminated) else signal.SIGINT


def parts_of(error: str) -> tuple[str, str]:
    """The message and the traceback of ``error``, which is one of them or both, in this order; a
    traceback alone ends with its message."""
    said, head, trace = error.partition(TRACEBACK)
    return said.strip() or trace.strip().rpartition("\n")[2], head + trace


def printable(text: str) -> str:
    """``text`` in one line that every terminal takes, at most ``LONGEST`` characters of it."""
    line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} … {line[-LONGEST // 2 :]}"


def unknown(kind: str, found: str, known: list[str]) -> UserError:
    """The error for a name that is not in a table; lists the names that are."""
    listed = ", ".join(sorted(known)) or "none"
    return UserError(f"unknown {kind} {found!r:.100}{perhaps(found, known) or ';'} known: {listed}")


def perhaps(found: str, known: Sequence[str]) -> str:
    """``; did you mean third_a?`` where ``found`` is in a name or nearly is, else ''."""
    from difflib import get_close_matches  # Only ever on the way out.

    word = found.strip().lower()
    near = [name for name in known if word and word in name.lower()]
    near = near or [name for name in known if get_close_matches(word, _pieces(name), 1, 0.75)]
    meant = sorted(near, key=len)[:3]
    return f"; did you mean {' or '.join(meant)}?" if meant else ""


def _pieces(name: str) -> list[str]:
    """Words of a name and those that follow each other: a, a-b, a-b-c, b, b-c, c of a-b/c."""
    words = name.lower().replace("/", "-").split("-")
    count = len(words)
    return ["-".join(words[i:j]) for i in range(count) for j in range(i + 1, count + 1)]
