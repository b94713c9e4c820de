"""A training run's folder: a policy folder that grows, and beside it what a killed run needs.

    DIR/config.json, weights.safetensors   the policy in its shipped form, replaced now and then
    DIR/curve.csv                          one row per progress report
    DIR/resume/run.json                    the run's configuration; a resumed run must have the same
    DIR/resume/state.pt                    full-precision tensors and numbers, to go on exactly
    DIR/resume/lock                        locked while a process trains here
    DIR/resume/finished                    the run is over: nothing else is left in resume/
    DIR/curve.svg                          the curve as a picture, where it has success by subset

DIR can be explored and evaluated at any time. State is written to a neighbour and renamed, so a run
killed at any moment finds its last whole state. With the recorded episodes it takes much room: 1 GB
for 20 rounds of hammer under the light recipe, of which the 3 MB of the policy stay at the end."""

from __future__ import annotations

import csv
import dataclasses
import errno
import json
import os
import pickle
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from madviz.errors import Terminated, UserError
from madviz.policies.checkpoint import CONFIG
from madviz.system.files import PART, read_json, read_rows, replacing, write_bytes
from madviz.system.lock import locked

Event = dict[str, Any]
"""A report of a run: ``kind`` and numbers; a page draws it, a terminal prints it."""


LOCK = "lock"
FINISHED = "finished"


@contextmanager
def alone_in(path: Path) -> Iterator[None]:
    """The run in the folder ``path`` is this process's alone meanwhile. Raises UserError if another
    one trains there. If no run begins meanwhile, nothing stays."""
    _check_folder(path)
    resume = path / "resume"
    resume.mkdir(parents=True, exist_ok=True)
    with locked(resume / LOCK) as descriptor:
        if descriptor is None:
            raise UserError(
                f"another process trains in {path}; wait for its end or stop it, "
                "or choose another --out"
            )
        try:
            yield
        finally:
            if [file.name for file in resume.iterdir()] == [LOCK]:
                shutil.rmtree(resume)
                if not any(path.iterdir()):
                    path.rmdir()
            elif not (resume / "run.json").exists() or (resume / FINISHED).exists():
                (resume / LOCK).unlink(missing_ok=True)


def _check_folder(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise UserError(f"expected a folder, found the file {path}; choose another --out")


class RunFolder:
    """See the module. ``listener`` gets every event as it happens."""

    def __init__(
        self,
        path: str | Path,
        config: Any,
        resume: bool,
        listener: Callable[[Event], None] | None,
    ) -> None:
        """``config``, a dataclass or a dict for JSON, is all that makes the run what it is.

        Raises UserError if the folder holds another run, a policy without a run, or no run although
        ``resume`` is set.
        """
        self.path = Path(path)
        self.resume = self.path / "resume"
        self.stopped_by = 0
        """The signal that asked the run to stop; 0 for none."""
        self._listener = listener
        self._over = self.resume / FINISHED
        facts = config if isinstance(config, dict) else dataclasses.asdict(config)
        described = json.dumps(facts, indent=1, sort_keys=True)
        self._check(json.loads(described), resume)
        self.resume.mkdir(parents=True, exist_ok=True)
        for half in self.resume.rglob(f"{PART}*"):
            half.unlink()  # A kill may leave one.
        write_bytes(self.resume / "run.json", described.encode())

    def _check(self, described: Any, resume: bool) -> None:
        """Raises UserError unless the run may begin or go on here."""
        file = self.resume / "run.json"
        _check_folder(self.path)
        if resume and not file.exists():
            raise UserError(f"nothing to resume: expected a run in {self.path}, found none")
        if self.finished and not resume:
            raise UserError(f"{self.path} holds a finished run; choose another --out")
        if file.exists() and not resume:
            raise UserError(
                f"{self.path} holds a run already; add --resume or choose another --out"
            )
        if not file.exists() and (self.path / CONFIG).exists():
            raise UserError(
                f"{self.path} holds a policy that was not trained here; choose another --out"
            )
        changed = changes(read_json(file), described) if resume else []
        if changed:
            raise UserError(
                f"the run in {self.path} has another configuration: {', '.join(changed)}; "
                "give the same options, or choose another --out"
            )

    @property
    def finished(self) -> bool:
        """Whether the run is over; a run that is, has no state."""
        return self._over.exists()

    @property
    def began(self) -> bool:
        """Whether there is a run to go on with."""
        return (self.resume / "run.json").exists()

    def finish(self) -> None:
        """The run is over: removes what only a run that goes on needs."""
        self._over.touch()
        for file in self.resume.iterdir():
            if file.is_dir():
                shutil.rmtree(file)
            elif file.name not in (FINISHED, LOCK, "run.json"):
                file.unlink()

    def forget(self) -> None:
        """Takes back a run that never began, of which there is nothing but its configuration: it
        must not stand in the way of the command without the mistake."""
        if {file.name for file in self.resume.iterdir()} <= {"run.json", LOCK}:
            (self.resume / "run.json").unlink()

    def save_state(self, state: dict[str, Any]) -> None:
        """``state`` may hold tensors, numbers, strings, lists and dicts; no other objects."""
        file = self.resume / "state.pt"
        with replacing(file) as part:
            try:
                torch.save(state, part)
            except RuntimeError as error:
                reason = str(error).splitlines()[0]
                raise OSError(errno.EIO, f"not written ({reason:.80})", str(file)) from error

    def load_state(self) -> dict[str, Any] | None:
        """The last whole state, in this computer's memory; None for a new run. Never unpickles
        objects. Raises UserError for a file that is none."""
        file = self.resume / "state.pt"
        if not file.exists():
            return None
        try:
            return torch.load(file, "cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
            reason = (str(error).splitlines() or [""])[0]
            raise UserError(
                f"{file}: expected the state of a run, found what could not be loaded "
                f"({reason:.80}); restore it, or choose another --out"
            ) from error

    def report(self, kind: str, **values: Any) -> None:
        """Tells the listener; rows of kind ``curve`` are also appended to curve.csv."""
        if kind == "curve":
            _append(self.path / "curve.csv", values)
        if self._listener:
            self._listener({"kind": kind, **values})

    def truncate_curve(self, column: str, limit: float) -> None:
        """Drops rows reported after the state that is resumed, so that none is there twice. A kill
        meanwhile leaves the rows as they were, or as they should be."""
        file = self.path / "curve.csv"
        if not file.exists():
            return
        rows = [row for row in read_rows(file) if float(row[column]) <= limit]
        with replacing(file) as part:
            for row in rows:
                _append(part, row)


def _append(file: Path, row: dict[str, Any]) -> None:
    """A row at the end of a CSV file, whole or not at all; its names come first in a new file."""
    before = file.stat().st_size if file.exists() else 0
    try:
        with file.open("a", newline="") as handle:
            writer = csv.DictWriter(handle, list(row))
            if not before:
                writer.writeheader()
            writer.writerow(row)
    except OSError:
        os.truncate(file, before)  # Half a row could not be read again.
        raise


def of_writing(error: OSError, folder: Path) -> bool:
    """True for an error of writing a run's files, and not one of a task or an expert."""
    place = folder.absolute()
    names = [Path(one).absolute() for one in (error.filename, error.filename2) if one is not None]
    ours = any(place in one.parents or one in (place, *place.parents) for one in names)
    return ours or error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)


def not_written(folder: Path, error: Exception) -> UserError:
    """The error where a run's files cannot be written, and what to do."""
    why = isinstance(error, OSError) and error.strerror or error
    return UserError(
        f"{folder}: expected a folder with room for the run, found: {why}; make room or choose "
        "another --out; a run that was saved before goes on with --resume"
    )


@contextmanager
def interruptible(folder: RunFolder) -> Iterator[threading.Event]:
    """Ctrl-C and SIGTERM set the event instead of breaking the loop off, and are noted in
    ``folder``; a second one interrupts at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: Any) -> None:
        if stop.is_set():
            raise Terminated if number == signal.SIGTERM else KeyboardInterrupt
        folder.stopped_by = number
        stop.set()

    before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def changes(before: Any, now: Any, name: str = "") -> list[str]:
    """The differences between two configurations, as ``paper.alpha 0.8 -> 0.5``.

    An option that a run's version did not know, or that only the stored one has, is no difference:
    new options leave runs that do not ask for them as they were.
    """
    if isinstance(before, dict) and isinstance(now, dict):
        shared = [key for key in before if key in now]
        return [c for k in shared for c in changes(before[k], now[k], f"{name}.{k}".lstrip("."))]
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True), start=1)
        return [c for i, (a, b) in pairs for c in changes(a, b, f"{name} {i}")]
    return [] if before == now else [f"{name} {_short(before)} -> {_short(now)}"]


def _short(value: Any) -> str:
    if isinstance(value, list | dict):
        names = [item.get("name", "?") if isinstance(item, dict) else str(item) for item in value]
        return f"[{', '.join(names)}]"
    return repr(value)
