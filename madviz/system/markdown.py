"""Markdown tables, as every file and every page of docs has them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Lines without a last line's end. Each row has as many cells as ``header``; a ``|`` inside a
    cell would begin another one."""
    head = " | ".join(header).rstrip()  # A last column without a name has one space.
    body = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([f"| {head} |", "|" + "---|" * len(header), *body])
