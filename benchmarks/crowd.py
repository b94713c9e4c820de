"""``benchmarks crowd``: how many visitors one machine can take, each with a simulation.

A server in a process of its own, visitors without browsers (``visitor.py``), one number of
them after the other. Each asks for 10 decisions a second and gets what the machine can give:

    visitors         1     2     4     8
    decisions/s   8.73  8.73  8.72  7.07    mean of each; 8.73 is the most (a pause ends an episode)
    cores         0.26  0.52  1.06  1.77    of the server and all its processes
    MB            1145  1450  2061  3257    proportional: what processes share counts once

Simulations all have other seeds' pictures, and the visitors only look; what a click costs is the
matter of ``benchmarks live``.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.memory import proportional_megabytes
from benchmarks.page_server import serving
from benchmarks.visitor import Visitor
from madviz.errors import UserError
from madviz.system.numbers import Count, Rate, ThreadsOrNone, Time
from madviz.system.processes import family

STARTING = 120.0
"""Seconds within which every visitor has a picture."""
SETTLING = 3.0
"""Seconds from then on until counting begins."""


@dataclass(frozen=True)
class CrowdConfig:
    """Visitors with a simulation each, on one machine: what each of them gets."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    visitors: tuple[Count, ...] = (1, 2, 4, 8)
    """How many at once, one number after the other."""
    policy: str = "metaworld-hammer-mad-light"
    """A name from ``madviz list``, a folder, or module:factory."""
    speed: Rate = 10.0
    """Decisions a second that each asks for."""
    seconds: Time = 15.0
    """How long decisions are counted."""
    workers: ThreadsOrNone = 0
    """Processes that measure success in the background."""


def bench_crowd(config: CrowdConfig) -> dict[str, Any]:
    """``visitors``, and for each number of them ``decisions_per_s`` (mean of each), ``least``,
    ``cores`` and ``mb``. Raises UserError where Linux's /proc is missing or no picture comes."""
    if not Path("/proc/self/smaps_rollup").exists():
        raise UserError("expected Linux for this benchmark, found no /proc/self/smaps_rollup")
    found = [_measured(config, count) for count in config.visitors]
    return {
        "schema": 1,
        "policy": config.policy,
        "speed": config.speed,
        "visitors": list(config.visitors),
        **{key: [one[key] for one in found] for key in found[0]},
    }


def _measured(config: CrowdConfig, count: int) -> dict[str, float]:
    words = ["--policy", config.policy, "--workers", str(config.workers)]
    words += ["--visitors", str(count), "--speed", str(config.speed)]
    with serving(words) as (url, process):
        visitors = [Visitor(url) for _ in range(count)]
        try:
            _await_pictures(visitors)
            time.sleep(SETTLING)
            rates, cores = _watched(visitors, process.pid, config.seconds)
            memory = proportional_megabytes(process.pid)
        finally:
            for visitor in visitors:
                visitor.close()
    return {
        "decisions_per_s": round(statistics.mean(rates), 2),
        "least": round(min(rates), 2),
        "cores": round(cores, 2),
        "mb": round(memory),
    }


def _await_pictures(visitors: Sequence[Visitor]) -> None:
    deadline = time.monotonic() + STARTING
    while not all(len(visitor.steps) > 2 for visitor in visitors):
        if time.monotonic() > deadline:
            raise UserError(f"expected a picture for every visitor within {STARTING:g} s")
        time.sleep(0.1)


def _watched(visitors: Sequence[Visitor], pid: int, seconds: float) -> tuple[list[float], float]:
    """Steps a second that each visitor got, and cores that the server used."""
    for visitor in visitors:
        visitor.steps.clear()
    start = time.monotonic()
    used = _cpu_seconds(pid)
    time.sleep(seconds)
    taken = time.monotonic() - start
    cores = (_cpu_seconds(pid) - used) / taken
    rates = [len({step for _, step in list(visitor.steps)}) / taken for visitor in visitors]
    return rates, cores


def _cpu_seconds(pid: int) -> float:
    """CPU seconds of a process and all its children that still live, since they began."""
    ticks = 0
    for one in family(pid):
        try:
            fields = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # It ended meanwhile.
            continue
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")
