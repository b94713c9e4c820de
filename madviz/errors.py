"""The error for a user's own mistake, and what it says about names."""

from __future__ import annotations

from collections.abc import Sequence


class UserError(ValueError):
    """A mistake the user can mend, in one line: what was expected, what was found, what next."""


def unknown(kind: str, found: str, known: list[str]) -> UserError:
    """The error for a name that is not in a table; lists the names that are."""
    listed = ", ".join(sorted(known))
    return UserError(f"unknown {kind} {found!r}; known: {listed}{perhaps(found, known)}")


def perhaps(found: str, known: Sequence[str]) -> str:
    """``; did you mean third_a?`` where ``found`` is in a name or nearly is, else ''."""
    from difflib import get_close_matches  # Only ever on the way out.

    said = found.strip().lower()
    near = [name for name in known if said and said in name.lower()]
    near = near or [name for name in known if get_close_matches(said, _pieces(name), 1, 0.75)]
    meant = sorted(near, key=len)[:3]
    return f"; did you mean {' or '.join(meant)}?" if meant else ""


def _pieces(name: str) -> list[str]:
    """Words of a name and those that follow each other: a, a-b, a-b-c, b, b-c, c of a-b/c."""
    words = name.lower().replace("/", "-").split("-")
    count = len(words)
    return ["-".join(words[i:j]) for i in range(count) for j in range(i + 1, count + 1)]
