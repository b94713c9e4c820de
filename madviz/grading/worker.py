"""The process in which one copy runs:
``python -m madviz.grading.worker COPY.ipynb REPORT SECONDS BYTES``.

It limits itself and all that it starts, runs the cells with nbclient, and writes a line for each
check and each error to REPORT at once: what was found before a copy crashes or is ended is kept. A
cell that takes longer than SECONDS is interrupted, as by Ctrl-C, and the next one runs.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import DeadKernelError

from madviz.errors import printable
from madviz.grading.inside import MIME
from madviz.system.processes import family

STARTUP = 120
"""Seconds for a kernel to start on a busy machine."""
LARGEST_FILE = 1 << 30
"""Bytes of a file that a copy writes."""
PR_SET_CHILD_SUBREAPER = 36
"""The constant of Linux's prctl.h: a process whose parent has ended becomes this one's child."""


class ReportFile:
    """Lines of JSON, written as they come."""

    def __init__(self, file: Path, seconds: float) -> None:
        self._file = file.open("a", buffering=1)
        self._seconds = seconds
        self.cell = 0

    def line(self, **fields: Any) -> None:
        """Writes a ``run.ReportLine``."""
        self._file.write(json.dumps(fields) + "\n")

    def started(self, cell: Any, cell_index: int) -> None:
        self.cell = cell_index + 1

    def executed(self, cell: Any, cell_index: int, execute_reply: dict) -> None:
        """After a cell: what its check found, or its error."""
        content = execute_reply["content"]
        for output in cell.outputs if "madviz" in cell.metadata else ():
            result = output.get("data", {}).get(MIME)
            if result and result.get("name") == cell.metadata.madviz:
                self.line(result=result)
                return
        if content["status"] == "error":
            message = f"{content['ename']}: {content['evalue']}".removesuffix(": ")
            if content["ename"] == "KeyboardInterrupt":
                message = f"did not end within {self._seconds:g} s"
            check = cell.metadata.get("madviz", "")
            self.line(error=printable(f"cell {cell_index + 1}: {message}"[:300]), check=check)


def bound(memory: int) -> None:
    """Limits of this process and of all it starts."""
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE, LARGEST_FILE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def main(arguments: list[str]) -> None:
    copy = Path(arguments[0])
    seconds = float(arguments[2])
    bound(int(arguments[3]))
    report = ReportFile(Path(arguments[1]), seconds)
    client = NotebookClient(
        nbformat.read(copy, 4),
        kernel_name="python3",
        timeout=int(seconds),
        startup_timeout=STARTUP,
        interrupt_on_timeout=True,
        allow_errors=True,
        resources={"metadata": {"path": str(copy.parent)}},
        on_cell_start=report.started,
        on_cell_executed=report.executed,
    )
    try:
        client.execute()
        report.line(end="")
    except DeadKernelError:
        report.line(end=f"the kernel ended in cell {report.cell}: a crash, or too much memory")
    finally:
        for process in family(os.getpid())[1:]:
            os.kill(process, signal.SIGKILL)


if __name__ == "__main__":
    main(sys.argv[1:])
