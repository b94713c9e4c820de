"""Recordings as tasks: ``recording/NAME``, where NAME is the dataset's folder.

A task's name stands in files, and a folder's place differs from machine to machine. So recordings
are known only where they were named, as ``--recording DATASET`` does, or in ``MADVIZ_RECORDINGS``,
folders with colons between. It is an environment variable because worker processes inherit those.
"""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from madviz.errors import UserError, unknown

if TYPE_CHECKING:
    from madviz.recorded.recordings import Recordings

VARIABLE = "MADVIZ_RECORDINGS"
SUITE = "recording"
LABEL = "recorded: actions change nothing"
"""Stands wherever something of a recording is shown."""


def is_recording(task: str) -> bool:
    """True for the name of recordings, known here or not."""
    return task.partition("/")[0] == SUITE


def known_recordings() -> dict[str, Path]:
    """The folders that were named here, by task. Raises UserError for two of one name."""
    known: dict[str, Path] = {}
    for each in os.environ.get(VARIABLE, "").split(os.pathsep):
        if each:
            _add(known, Path(each).resolve())
    return known


def _add(known: dict[str, Path], folder: Path) -> str:
    task = f"{SUITE}/{folder.name}"
    if known.setdefault(task, folder) != folder:
        raise UserError(
            f"expected every folder of recordings to have a name of its own, found {folder} beside "
            f"{known[task]}; rename one"
        )
    return task


def allow_recording(folder: Path) -> str:
    """Makes the recordings in ``folder`` known to this process and all that it starts; returns the
    task. Raises UserError for a folder of no use, or of the same name as another one."""
    path = folder.resolve()
    if os.pathsep in str(path):
        raise UserError(f"{path}: expected a path without {os.pathsep!r}; rename the folder")
    recordings_in(path)
    known = known_recordings()
    task = _add(known, path)
    os.environ[VARIABLE] = os.pathsep.join(map(str, known.values()))
    return task


def check_recording(task: str) -> None:
    """Raises UserError for recordings that nobody has named here."""
    known = known_recordings()
    if task not in known:
        raise UserError(
            f"{unknown('recording', task, list(known))}; name its folder: --recording DATASET, or "
            f"{VARIABLE}=FOLDER"
        )


def recordings_of(task: str) -> Recordings:
    """The recordings of ``recording/NAME``. Raises UserError as ``check_recording`` and
    ``open_recordings`` do."""
    check_recording(task)
    return recordings_in(known_recordings()[task])


def refuse_recording(task: str, what: str) -> None:
    """Raises UserError where ``what``, for example counting successes, needs a robot that moves."""
    if is_recording(task):
        raise UserError(
            f"expected a task in a simulator for {what}, found {task} ({LABEL}); "
            "madviz explore and madviz audit take recordings"
        )


@lru_cache(maxsize=8)
def recordings_in(path: Path) -> Recordings:
    """``open_recordings``, once for each process."""
    from madviz.recorded.recordings import open_recordings  # Its libraries take 0.4 s to load.

    return open_recordings(path)
