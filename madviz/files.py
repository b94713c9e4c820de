"""Files that are whole or not there, and JSON that a person can read."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any, NoReturn

from madviz.types import UserError

LINE = 120
"""Characters that a list or object may take to stay on one line."""


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
    """Indented JSON in which every list or object that fits on a line stays on one."""
    return _laid_out(value, "\n") + "\n"


def read_json(path: Path) -> Any:
    """Parses a file. Raises UserError if it is not there or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"{path}: expected a JSON file, found: {reason}; restore it") from error


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant}, which is not JSON")


def _laid_out(value: Any, newline: str) -> str:
    flat = json.dumps(value, allow_nan=False)
    if len(flat) <= LINE or not isinstance(value, dict | list | tuple):
        return flat
    inner = newline + "  "
    if isinstance(value, dict):
        items = [f"{json.dumps(str(k))}: {_laid_out(v, inner)}" for k, v in value.items()]
        return "{" + inner + f",{inner}".join(items) + newline + "}"
    return "[" + inner + f",{inner}".join(_laid_out(v, inner) for v in value) + newline + "]"
