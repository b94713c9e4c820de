"""What every mistake on the command line is answered with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from madviz import cli


def refused(
    words: Sequence[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
    main: Callable[[Sequence[str]], int] = cli.main,
) -> str:
    """The line that ``main`` answers ``words`` with, which has ``said`` in it: one line on
    standard error, nothing on standard output, and exit code 2."""
    assert main(list(words)) == 2, words
    printed = capsys.readouterr()
    assert printed.out == "" and said in printed.err, printed
    assert printed.err.startswith("madviz: ") and printed.err.count("\n") == 1
    return printed.err
