"""A training run's folder: a policy folder that grows, and beside it what a killed run needs.

DIR/config.json, weights.safetensors   the policy in its shipped form, replaced as training goes on
    DIR/curve.csv                          one row per progress report
    DIR/resume/run.json                    the run's configuration; a resumed run must have the same
DIR/resume/state.pt                    full-precision tensors and numbers, enough to go on exactly

DIR can be explored and evaluated at any time; ``resume/`` may be deleted when the run is over.
State is written to a neighbour and renamed, so a run killed at any moment finds its last whole
state."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from madviz.files import write_bytes
from madviz.types import UserError

Event = dict[str, Any]
"""What a run reports: ``kind`` and numbers; a page draws it, a terminal prints it."""


class RunFolder:
    """See the module. ``listener`` gets every event as it happens."""

    def __init__(
        self, path: str | Path, config: Any, resume: bool, listener: Callable[[Event], None] | None
    ) -> None:
        """Raises UserError if the folder holds another run, or none although ``resume`` is set."""
        self.path = Path(path)
        self.resume = self.path / "resume"
        self._listener = listener
        described = json.dumps(dataclasses.asdict(config), indent=1, sort_keys=True)
        file = self.resume / "run.json"
        if self.path.exists() and not self.path.is_dir():
            raise UserError(f"expected a folder, found the file {self.path}; choose another --out")
        if resume and not file.exists():
            raise UserError(f"nothing to resume: expected a run in {self.path}, found none")
        if file.exists() and not resume:
            raise UserError(
                f"{self.path} holds a run already; add --resume or choose another --out"
            )
        if resume and file.read_text() != described:
            changed = _changed(json.loads(file.read_text()), json.loads(described))
            raise UserError(f"the run in {self.path} has another configuration: {changed}")
        self.resume.mkdir(parents=True, exist_ok=True)
        write_bytes(file, described.encode())

    def save_state(self, state: dict[str, Any]) -> None:
        """``state`` may hold tensors, numbers, strings, lists and dicts; no other objects."""
        temporary = self.resume / "state.tmp"
        torch.save(state, temporary)
        os.replace(temporary, self.resume / "state.pt")

    def load_state(self) -> dict[str, Any] | None:
        """The last whole state, or None for a new run. Never unpickles objects."""
        file = self.resume / "state.pt"
        return torch.load(file, weights_only=True) if file.exists() else None

    def report(self, kind: str, **values: Any) -> None:
        """Tells the listener; rows of kind ``curve`` are also appended to curve.csv."""
        if kind == "curve":
            self._append(values)
        if self._listener:
            self._listener({"kind": kind, **values})

    def truncate_curve(self, column: str, limit: float) -> None:
        """Drops rows reported after the state that is resumed, so that none is there twice."""
        file = self.path / "curve.csv"
        if not file.exists():
            return
        with file.open(newline="") as handle:
            rows = [row for row in csv.DictReader(handle) if float(row[column]) <= limit]
        file.unlink()
        for row in rows:
            self._append(row)

    def _append(self, row: dict[str, Any]) -> None:
        file = self.path / "curve.csv"
        fresh = not file.exists()
        with file.open("a", newline="") as handle:
            writer = csv.DictWriter(handle, list(row))
            if fresh:
                writer.writeheader()
            writer.writerow(row)


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Ctrl-C (and a polite kill) set the event instead of tearing the loop apart; a second one
    interrupts at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: Any) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _changed(before: dict[str, Any], now: dict[str, Any]) -> str:
    keys = [k for k in {**before, **now} if before.get(k) != now.get(k)]
    return ", ".join(f"{k} {before.get(k)!r} -> {now.get(k)!r}" for k in sorted(keys))
