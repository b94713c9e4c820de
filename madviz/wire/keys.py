"""The keys under which a look goes out, and whether any two of them clash.

                 vla-eval                           openpi
    pictures     in the table ``images``            beside all others
    instruction  ``task_description``               ``prompt``

A key is a path through tables: ``["images", "cam_high"]`` leads through one. Two entries clash
where one path is the other, or its beginning: the later value would replace the earlier one.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

from madviz.errors import UserError
from madviz.wire.codec import MARKS, Protocol

Key = str | list[str]
KeyPath = tuple[str, ...]
MOST_TABLES = 8
"""The deepest key, in tables."""
PLACES: dict[Protocol, tuple[KeyPath, str]] = {
    "vla-eval": (("images",), "task_description"),
    "openpi": ((), "prompt"),
}
"""By protocol, the table of the pictures and the key of the instruction."""


def outgoing(
    protocol: Protocol, cameras: dict[str, Key], state: Key, noise: str
) -> dict[str, KeyPath]:
    """By entry of the wire file (``cameras.first``), where its value stands in a look."""
    pictures, instruction = PLACES[protocol]
    paths: dict[str, KeyPath] = {"instruction": (instruction,)}
    for name, key in cameras.items():
        paths[f"cameras.{name}"] = (*pictures, *_path(key))
    if state != "":
        paths["state"] = _path(state)
    if noise:
        paths["noise"] = (noise,)
    return paths


def check_paths(paths: dict[str, KeyPath], where: str) -> None:
    """Raises UserError where two entries of ``paths`` clash, or a key is none."""
    for entry, path in paths.items():
        _check_path(entry, path, where)
    for (entry, path), (other, longer) in combinations(paths.items(), 2):
        shared = min(path, longer, key=len)
        if path[: len(shared)] == longer[: len(shared)]:
            raise UserError(
                f"{where}: expected a key of its own for each entry, found {entry!r} and {other!r} "
                f"both at {'.'.join(shared)!r:.100}; give one of them another key"
            )


def put(message: dict[str, Any], path: KeyPath, value: Any) -> None:
    """``value`` at ``path`` of ``message``; tables on the way are made."""
    *tables, last = path
    for name in tables:
        message = message.setdefault(name, {})
    message[last] = value


def _check_path(entry: str, path: KeyPath, where: str) -> None:
    if "" in path:
        raise UserError(
            f"{where}: expected {entry!r} to be a key or a list of keys, found an empty one; "
            "say how the server calls it"
        )
    if len(path) > MOST_TABLES:
        raise UserError(
            f"{where}: expected {entry!r} to be at most {MOST_TABLES} tables deep, found "
            f"{len(path)}; shorten it"
        )
    if marks := sorted(set(path) & MARKS):
        raise UserError(
            f"{where}: expected {entry!r} to be a key of the server's own, found {marks[0]!r}, "
            "which marks an array; give it another one"
        )


def _path(key: Key) -> KeyPath:
    return (key,) if isinstance(key, str) else tuple(key) or ("",)
