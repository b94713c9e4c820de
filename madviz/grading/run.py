"""Runs one copy in a process of its own, within limits, and ends all that it has started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import nbformat

from madviz.errors import printable
from madviz.system.processes import family
from madviz.teaching.checks.exercise import Result

KEPT = ("PATH", "LANG", "PYTHONPATH", "LD_LIBRARY_PATH", "XDG_DATA_DIRS")
"""The variables of this process's environment that a copy gets."""
CELL = 0.5
"""The share of a copy's time that one cell may take: so one endless cell leaves time for the
others."""
STEP = 0.1
"""Seconds between two looks at a copy that runs."""
OVER = "over"


@dataclass
class CopyRun:
    """The result of a copy."""

    results: dict[str, Result] = field(default_factory=dict)
    """By name, each check that was reached."""
    errors: dict[str, str] = field(default_factory=dict)
    """For a check: the last error between it and the check before it."""
    end: str = ""
    """Why it did not come to its end; '' if it did."""


class ReportLine(msgspec.Struct):
    """A line that a copy's process writes: one of these."""

    result: Result | None = None
    error: str = ""
    check: str = ""
    """The exercise whose own check raised ``error``; '' for another cell."""
    end: str = ""


def run_copy(
    notebook: nbformat.NotebookNode,
    policies: list[Path],
    seconds: float,
    memory: int,
    stop: threading.Event,
) -> CopyRun:
    """Runs ``notebook`` in an empty folder, for ``seconds`` and with ``memory`` bytes of data for
    each of its processes at most."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place:
        work = Path(place, "work")
        report = Path(place, "report")
        for folder in (work, Path(place, "home"), Path(place, "tmp")):
            folder.mkdir()
        nbformat.write(notebook, work / "copy.ipynb")
        arguments = [work / "copy.ipynb", report, seconds * CELL, memory]
        with Path(place, "output").open("wb") as output:
            worker = subprocess.Popen(
                [sys.executable, "-m", "madviz.grading.worker", *map(str, arguments)],
                cwd=work,
                env=environment(Path(place), policies),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
            end = watch(worker, began + seconds, stop)
        run = read(report)
    if end or worker.returncode:
        run.end = run.end or end or "its process ended without a word: too much memory or output"
    if end == OVER:
        run.end = f"it did not end within {seconds:g} s"
    return run


def watch(worker: subprocess.Popen, deadline: float, stop: threading.Event) -> str:
    """Waits for a copy's process, and ends it where that takes too long. In any case it ends what
    was seen under it and what is under that: a copy can kill the process that would do so."""
    seen: dict[int, str] = {}
    try:
        while worker.poll() is None:
            seen |= {process: started(process) for process in family(worker.pid)}
            if stop.is_set():
                return "stopped"
            if time.monotonic() >= deadline:
                return OVER
            time.sleep(STEP)
        return ""
    finally:
        left = [process for process, start in seen.items() if start and start == started(process)]
        for process in {each for one in left for each in family(one)}:
            with suppress(OSError):
                os.kill(process, signal.SIGKILL)
        worker.kill()
        worker.wait()


def started(process: int) -> str:
    """The time at which a process began, as Linux counts it; '' if it is gone. A number of a
    process that has ended is given to another one, with another time."""
    try:
        text = Path(f"/proc/{process}/stat").read_text(errors="replace")
    except OSError:
        return ""
    return text.rpartition(")")[2].split()[19]  # Before it is a name of the copy's choice.


def environment(place: Path, policies: list[Path]) -> dict[str, str]:
    """A home and a folder for temporary files of its own, one core, no display."""
    return {
        **{name: os.environ[name] for name in KEPT if name in os.environ},
        "OMP_NUM_THREADS": "1",
        "LP_NUM_THREADS": "1",
        "HOME": str(place / "home"),
        "TMPDIR": str(place / "tmp"),
        "MUJOCO_GL": "egl",
        "PYTHONNOUSERSITE": "1",
        "MADVIZ_CHECKPOINTS": os.pathsep.join(map(str, policies)),
    }


def read(report: Path) -> CopyRun:
    """The lines that a copy's process has written. The last one may be half of one, and a student's
    code may have made up a result; such lines are passed over."""
    run = CopyRun()
    error = ""
    there = report.is_file()  # A folder or a pipe may have taken its place.
    for text in report.read_text(errors="replace").splitlines() if there else []:
        try:
            line = msgspec.json.decode(text, type=ReportLine)
        except (msgspec.DecodeError, RecursionError):
            continue
        if line.result is not None:
            run.results[line.result.name] = line.result
            run.errors[line.result.name] = error
            error = ""
        elif line.error and line.check:
            run.errors[line.check] = error or printable(line.error)
            error = ""
        elif line.error:
            error = printable(line.error)
        else:
            run.end = line.end
    return run
