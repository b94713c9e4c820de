"""priority.py: what may wait has a session of its own, and only that session waits."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from madviz.system.priority import lowest_priority

AUTOGROUP = Path("/proc/self/autogroup")
with_sessions = pytest.mark.skipif(
    not AUTOGROUP.exists(), reason="the system has no niceness of sessions"
)

LOWER = """
import os
from madviz.system.priority import lower_own_priority

if os.fork() == 0:
    before = os.getsid(0)
    lower_own_priority(7)
    print(os.getsid(0) == os.getpid() != before, os.nice(0), flush=True)
    print(open("/proc/self/autogroup").read(), open(f"/proc/{before}/autogroup").read())
    os._exit(0)
os.wait()
"""


def niceness_of(text: str) -> list[int]:
    """Of the sessions that ``text`` names."""
    return [int(found) for found in re.findall(r"nice (-?\d+)", text)]


@with_sessions
def test_a_process_lowers_itself_and_not_the_session_it_came_from() -> None:
    said = subprocess.check_output([sys.executable, "-c", LOWER], text=True, start_new_session=True)
    own, sessions = said.split("\n", 1)
    assert own == f"True {min(os.nice(0) + 7, 19)}"
    assert niceness_of(sessions) == [7, 0]


@with_sessions
def test_another_process_is_lowered_with_its_session(child: subprocess.Popen[bytes]) -> None:
    here = AUTOGROUP.read_text()
    lowest_priority(child.pid)
    assert niceness_of(Path(f"/proc/{child.pid}/autogroup").read_text()) == [19]
    assert os.getpriority(os.PRIO_PROCESS, child.pid) == 19
    assert os.sched_getscheduler(child.pid) == os.SCHED_IDLE
    assert AUTOGROUP.read_text() == here


@with_sessions
def test_linux_that_refuses_for_now_is_asked_again(
    child: subprocess.Popen[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes one change in 0.1 s from users who are not root."""
    real, asked = Path.write_text, []

    def write(file: Path, text: str) -> int:
        asked.append(file)
        if len(asked) < 3:
            raise BlockingIOError
        return real(file, text)

    monkeypatch.setattr(Path, "write_text", write)
    lowest_priority(child.pid)
    assert len(asked) == 3
    assert niceness_of(asked[0].read_text()) == [19]


@pytest.fixture
def child() -> Iterator[subprocess.Popen[bytes]]:
    """A process that does nothing, in a session of its own."""
    sleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    with subprocess.Popen(sleep, start_new_session=True) as process:
        yield process
        process.kill()
