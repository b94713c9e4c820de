"""Grading: what is read of a copy's report, and that no process of a copy outlives it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from madviz.grading import run as grading_run
from madviz.grading.run import CopyRun, read, started, watch
from tests.pages import until


def test_half_a_report_counts(tmp_path: Path) -> None:
    lines = [
        json.dumps({"error": "cell 3: ZeroDivisionError"}),
        json.dumps({"result": {"name": "02.merge", "passed": True, "missing": "", "error": ""}}),
        json.dumps({"result": {"name": "02.mean"}}),  # A student's code has made it up.
        '{"result": {"na',
    ]
    (tmp_path / "report").write_text("\n".join(lines))
    run = read(tmp_path / "report")
    assert run.results.keys() == {"02.merge"} and run.results["02.merge"].passed
    assert run.errors == {"02.merge": "cell 3: ZeroDivisionError"}
    assert read(tmp_path / "none").results == {}


RIGHT_LINE = '{"result": {"name": "02.merge", "passed": true}}\n'
NOT_READ: list[Callable[[Path], object]] = [
    lambda report: report.write_bytes(b"caf\xe9\n" + RIGHT_LINE.encode()),
    lambda report: report.write_text('{"x": ' + "[" * 100_000 + "\n" + RIGHT_LINE),
    Path.mkdir,
    os.mkfifo,
]


@pytest.mark.parametrize("overwrite", NOT_READ)
def test_a_report_that_a_copy_has_written_over_is_read_as_far_as_it_goes(
    tmp_path: Path, overwrite: Callable[[Path], object]
) -> None:
    report = tmp_path / "report"
    overwrite(report)
    found: list[CopyRun] = []
    reader = threading.Thread(target=lambda: found.append(read(report)), daemon=True)
    reader.start()
    reader.join(20)
    assert [len(run.results) for run in found] == [int(report.is_file())]


def test_a_process_of_a_copy_does_not_outlive_one_that_is_killed() -> None:
    script = "setsid sleep 97 & echo $!; sleep 0.5; kill -9 $$"
    worker = subprocess.Popen(["sh", "-c", script], stdout=subprocess.PIPE, text=True)
    assert worker.stdout is not None
    sleeper = int(worker.stdout.readline())
    start = started(sleeper)
    assert start and watch(worker, time.monotonic() + 60, threading.Event()) == ""
    until(lambda: not lives(sleeper, start))


def lives(process: int, start: str) -> bool:
    state = Path(f"/proc/{process}/stat")
    return started(process) == start and ") Z " not in state.read_text()


class Ended:
    """A copy's process that is seen once, then has ended."""

    pid = 100

    def __init__(self) -> None:
        self.polls: list[int | None] = [None]

    def poll(self) -> int | None:
        return self.polls.pop() if self.polls else -9

    def kill(self) -> None: ...

    def wait(self) -> None: ...


def test_what_a_survivor_has_started_is_ended_and_a_number_that_is_used_again_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """101 is a kernel, which starts 103 after the last look; 102 has ended, and another process
    has its number."""
    families = {100: [100, 101, 102], 101: [101, 103], 102: [102, 104]}
    starts = {100: iter(("1", "")), 101: iter(("2", "2")), 102: iter(("3", "9"))}
    killed: list[tuple[int, int]] = []
    monkeypatch.setattr(grading_run, "family", lambda pid: families[pid])
    monkeypatch.setattr(grading_run, "started", lambda pid: next(starts[pid]))
    monkeypatch.setattr(os, "kill", lambda *words: killed.append(words))
    assert watch(Ended(), time.monotonic() + 60, threading.Event()) == ""  # pyright: ignore
    assert sorted(killed) == [(101, signal.SIGKILL), (103, signal.SIGKILL)]
