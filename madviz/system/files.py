"""Files that are whole or not there, and JSON that a person can read."""

from __future__ import annotations

import csv
import errno
import json
import math
import os
import resource
import shutil
import stat
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

from madviz.errors import UserError

LINE = 120
"""Characters that a list or object may take to stay on one line."""
DEEPEST = 50
"""Lists and objects inside one another that a file may have; Python's own limit is an error."""
PART = ".madviz-"
"""How files begin that are being written; a kill may leave one."""
_UNFIT = {
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
    stat.S_IFLNK: "symbolic links in a circle",
}
"""Kinds of files that can be neither replaced nor written to."""


OTHERS = 256
"""Files that a process has open besides those it asks for."""


def allow_open_files(count: int) -> None:
    """Lets this process keep ``count`` files open. Raises UserError if the system does not."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = count + OTHERS
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    except (ValueError, OSError) as error:
        raise UserError(
            f"expected {wanted} files to be open at a time, found a limit of {hard}; raise it "
            "(ulimit -Hn), or use fewer episodes"
        ) from error


def written_to(path: Path, option: str = "") -> bool:
    """Whether ``path`` is a device, a pipe or already open, so that it is written to and never
    replaced. Symbolic links are followed. Raises UserError, which names ``option``, for what is
    neither that nor a place for a file; whoever works long before writing asks before, too."""
    named = f"{option} {path}".strip()
    target = os.path.realpath(path)
    there = os.path.exists(path)
    mode = os.stat(path).st_mode if there else stat.S_IFLNK if os.path.islink(target) else 0
    if found := _UNFIT.get(stat.S_IFMT(mode)):
        raise UserError(
            f"{named}: expected a file, a device or a pipe, found {found}; choose another name"
        )
    try:
        if there and (not stat.S_ISREG(mode) or _is_open(path)):
            if not os.access(path, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return True
        if not os.path.isdir(os.path.dirname(target)):
            raise UserError(
                f"{named}: expected a file in a folder that exists, found no folder "
                f"{os.path.dirname(target)}; make it, or choose another name"
            )
        with suppress(FileNotFoundError):
            os.stat(target)  # A name may be too long.
        part = _part(Path(target), Path(target).parent)
        try:
            part.write_bytes(b" ")  # A disk may be full.
        finally:
            part.unlink()
    except OSError as error:
        raise UserError(
            f"{named:.200}: expected a place that can be written to, found: {error.strerror}; "
            "choose another"
        ) from error
    return False


def _part(path: Path, folder: Path | None) -> Path:
    """A new file with the ending of ``path``."""
    handle, name = tempfile.mkstemp(dir=folder, prefix=PART, suffix=path.suffix[:16])
    os.close(handle)
    return Path(name)


def _is_open(path: Path) -> bool:
    """Whether ``path`` leads, as /dev/stdout does, to what a process has opened. It goes on writing
    there, so a new file in its place would lose what comes after."""
    while path.is_symlink():
        folder = path.parent.resolve()
        if folder.is_relative_to("/proc"):
            return True
        path = folder / path.readlink()
    return False


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new file to write to, with the ending of ``path``; after the block, ``path`` has its
    content. A file is replaced by it at once: whoever reads, also after a power cut, finds the old
    one or the new one, never half of one. If the block fails, ``path`` stays as it is."""
    stays = written_to(path)
    target = Path(os.path.realpath(path))
    part = _part(path, None if stays else target.parent)
    try:
        yield part
        with part.open("rb") as file:
            if stays:
                with open(os.open(path, os.O_WRONLY | os.O_APPEND), "wb") as there:
                    shutil.copyfileobj(file, there)
                return
            os.fsync(file.fileno())
        part.chmod(0o644)  # mkstemp's files are private; these are to be shared.
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder to write to; after the block it is ``out``, which must not be there or be empty.
    Whoever finds ``out`` finds all of it. If the block fails, nothing stays."""
    out = out.resolve()  # ``.`` and a link cannot be removed.
    part = Path(tempfile.mkdtemp(dir=out.parent, prefix=PART))
    try:
        yield part
        part.chmod(0o755)  # mkdtemp's folders are private; these are to be shared.
        with suppress(FileNotFoundError):
            out.rmdir()
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/madviz``; in ``~/.cache`` if the variable is not set."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "madviz"


def write_bytes(path: Path, content: bytes) -> None:
    """Gives ``path`` this content, as ``replacing`` does."""
    with replacing(path) as part:
        part.write_bytes(content)


def write_json(path: Path, value: Any) -> None:
    """Writes ``value`` as ``pretty`` lays it out. Raises ValueError for NaN: JSON has none."""
    write_bytes(path, pretty(value).encode())


def pretty(value: Any) -> str:
    """Indented JSON in which every list or object that fits on a line stays on one."""
    return _laid_out(value, "\n") + "\n"


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file by its first line, but those with a field too few, which are being
    written; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as text:
        return [row for row in csv.DictReader(text) if None not in row.values()]


def read_json(path: Path) -> Any:
    """Parses a file. Raises UserError if it is not there, not JSON, or of a depth, with numbers or
    with text that could not be handled or written again."""
    try:
        text = path.read_text(encoding="utf-8")
        return _bounded(json.loads(text, parse_constant=_refuse, parse_float=_finite))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path}: expected a JSON file, found: {_why(error)}; restore it"
        ) from error


def read_toml(path: Path, what: str, fix: str) -> dict[str, Any]:
    """Parses a file. Raises UserError if it is not there or not TOML, or too deep; ``what`` it is
    and ``fix``, the next move, are for the message."""
    try:
        return _bounded(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError) as error:
        expected = what if isinstance(error, OSError) else "TOML"
        raise UserError(f"{path}: expected {expected}, found: {_why(error)}; {fix}") from error


def _why(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return f"more than {DEEPEST} lists and tables inside one another"
    return str(isinstance(error, OSError) and error.strerror or error)


def _bounded(value: Any) -> Any:
    """``value``, if it is not too deep and its text can be written again; else RecursionError or
    ValueError."""
    level = [value]
    for _ in range(DEEPEST):
        inner: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                inner += [*item.keys(), *item.values()]
            elif isinstance(item, list):
                inner += item
            elif isinstance(item, str):
                item.encode()
        level = inner
    if level:
        raise RecursionError
    return value


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant}, which is not JSON")


def _finite(number: str) -> float:
    if math.isinf(value := float(number)):
        raise ValueError(f"{number:.20}, which is too large a number")
    return value


def _laid_out(value: Any, newline: str) -> str:
    flat = json.dumps(value, allow_nan=False)
    if len(flat) <= LINE or not isinstance(value, dict | list | tuple):
        return flat
    inner = newline + "  "
    if isinstance(value, dict):
        items = [f"{json.dumps(str(k))}: {_laid_out(v, inner)}" for k, v in value.items()]
        return "{" + inner + f",{inner}".join(items) + newline + "}"
    return "[" + inner + f",{inner}".join(_laid_out(v, inner) for v in value) + newline + "]"
