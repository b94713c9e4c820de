"""processes.py: what a process keeps of its memory."""

from __future__ import annotations

import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import numpy as np
from madviz.system.processes import keep_large_blocks

def work():
    blocks = [np.ones(4 << 20, np.float32) for _ in range(5)]  # 16 MB each

if sys.argv[1] == "keep":
    keep_large_blocks()
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's malloc alone is told")
def test_the_next_update_finds_the_memory_of_the_last() -> None:
    """A page that was touched before costs no fault again; without the setting thousands do."""
    faults = {
        how: int(subprocess.check_output([sys.executable, "-c", FAULTS, how], text=True))
        for how in ("keep", "as it is")
    }
    assert faults["keep"] < 100 < 1000 < faults["as it is"]
