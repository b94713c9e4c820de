"""Files that are whole or not there, and JSON that a person can read."""

from __future__ import annotations

import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any, NoReturn

from madviz.types import UserError

_LINE = 100
_FLAT = re.compile(r"([\[{])\n\s+([^\[\]{}]*?)\n\s*([\]}])")
"""A list or object with no other inside. A text cannot start a match: it holds no line breaks."""


def write_bytes(path: Path, content: bytes) -> None:
    """Writes beside ``path`` and renames: whoever reads, also after a power cut, finds the old
    file or the new one, never half of one."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp's files are private; these are to be shared.
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


def write_json(path: Path, value: Any) -> None:
    """Writes ``value`` as ``pretty`` lays it out. Raises ValueError for NaN: JSON has none."""
    write_bytes(path, pretty(value).encode())


def pretty(value: Any) -> str:
    """Indented JSON in which a list or object that fits on a line stays on one."""
    return _FLAT.sub(_on_one_line, json.dumps(value, indent=2, allow_nan=False)) + "\n"


def read_json(path: Path) -> Any:
    """Parses a file. Raises UserError if it is not there or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"{path}: expected a JSON file, found: {reason}; restore it") from error


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant}, which is not JSON")


def _on_one_line(match: re.Match[str]) -> str:
    opening, inside, closing = match.groups()
    line = opening + re.sub(r"\n\s*", " ", inside) + closing
    return line if len(line) <= _LINE else match.group(0)
