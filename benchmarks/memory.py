"""Memory of processes as Linux counts it, in ``/proc/PID``."""

from __future__ import annotations

from pathlib import Path

from madviz.system.processes import family

HERE = Path("/proc/self/status")


def kilobytes(field: str, status: Path = HERE) -> int | None:
    """``VmRSS`` (memory occupied now) or ``VmHWM`` (its peak) of a process; None where the system
    does not tell. Raises OSError if the process has ended."""
    if not HERE.exists():
        return None
    lines = status.read_text().splitlines()
    return next((int(line.split()[1]) for line in lines if line.startswith(f"{field}:")), 0)


def proportional_megabytes(pid: int) -> float:
    """Memory of ``pid`` and all processes under it; a page that n processes share counts a nth for
    each, so that it counts once in all (PSS)."""
    total = 0
    for one in family(pid):
        try:
            lines = Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        total += next((int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0)
    return total / 1024
