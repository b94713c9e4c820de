"""Memory of a process as Linux counts it, in ``/proc/PID/status``."""

from __future__ import annotations

from pathlib import Path

HERE = Path("/proc/self/status")


def kilobytes(field: str, status: Path = HERE) -> int | None:
    """``VmRSS`` (memory occupied now) or ``VmHWM`` (its peak) of a process; None where the system
    does not tell. Raises OSError if the process has ended."""
    if not HERE.exists():
        return None
    lines = status.read_text().splitlines()
    return next((int(line.split()[1]) for line in lines if line.startswith(f"{field}:")), 0)
