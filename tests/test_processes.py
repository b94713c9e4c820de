"""processes.py: workers end with their parent, and memory is used again."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

FAULTS = """
import resource, sys
import numpy as np
from madviz.system.processes import reuse_large_blocks

def work():
    blocks = [np.ones(4 << 20, np.float32) for _ in range(5)]  # 16 MB each

if sys.argv[1] == "reuse":
    reuse_large_blocks()
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""

PARENT = """
import multiprocessing, os, sys, time
from concurrent.futures import ProcessPoolExecutor
from madviz.system.processes import set_up_worker

def work(seconds):
    time.sleep(seconds)
    return os.getpid()

if __name__ == "__main__":
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn, initializer=set_up_worker) as pool:
        workers = {*pool.map(work, [0.5, 0.5])}
        if sys.argv[1] == "busy":
            jobs = [pool.submit(work, 100.0) for _ in workers]
        print(*workers, flush=True)
        time.sleep(100.0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc's malloc has the setting")
def test_the_next_update_finds_the_memory_of_the_last() -> None:
    """A page that was touched before costs no fault again; without the setting thousands do."""
    faults = {
        how: int(subprocess.check_output([sys.executable, "-c", FAULTS, how], text=True))
        for how in ("reuse", "default")
    }
    assert faults["reuse"] < 100 < 1000 < faults["default"]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("workers_are", ["idle", "busy"])
def test_workers_of_a_killed_parent_end_within_five_seconds(
    tmp_path: Path, workers_are: str
) -> None:
    program = tmp_path / "parent.py"
    program.write_text(PARENT)
    command = [sys.executable, str(program), workers_are]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(pid) for pid in parent.stdout.readline().split()]
        assert workers and all(runs(pid) for pid in workers)
        parent.kill()
    until = time.monotonic() + 5.0
    while any(runs(pid) for pid in workers) and time.monotonic() < until:
        time.sleep(0.05)
    left = [pid for pid in workers if runs(pid)]
    for pid in left:
        os.kill(pid, 9)
    assert left == []


def runs(pid: int) -> bool:
    """Whether the process is there, and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
