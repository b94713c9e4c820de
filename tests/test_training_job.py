"""A training beside the page: a real child process, with a small program in the trainer's place."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from madviz.app.panels.training import TrainingPanel, training_html
from madviz.errors import UserError
from madviz.policies.checkpoint import load_policy
from madviz.training.job import JobConfig, JobStatus, TrainingJob
from tests.pages import recorded, use
from tests.sessions import frame_with

PROGRAM = """
import signal, sys, time
from pathlib import Path
words = sys.argv[1:]
out = Path(words[words.index("--out") + 1])
stop = []
signal.signal(signal.SIGTERM, lambda *_: stop.append(1))
(out / "resume").mkdir(exist_ok=True)
(out / "resume" / "run.json").write_text("{}")
if "merged-only" in words:
    sys.exit("expected sugar, found salt; taste first")
curve = out / "curve.csv"
if not curve.exists():
    curve.write_text("round,seconds,seconds_left,loss,student_success\\n")
(out / "weights.safetensors").write_bytes(b"w")
(out / "config.json").write_text('{"name": "finished"}')
for number in range(1, 3 if "--resume" in words else 1000):
    with curve.open("a") as file:
        file.write(f"{number},{number}.0,{9 - number}.0,0.5,\\n")
    if stop:
        print("madviz: stopped; resume with: madviz train --resume", file=sys.stderr)
        sys.exit(143)
    time.sleep(0.02)
"""


@pytest.fixture
def job(tmp_path: Path) -> Iterator[TrainingJob]:
    (tmp_path / "trainer.py").write_text(PROGRAM)
    job = TrainingJob(tmp_path / "runs", (sys.executable, str(tmp_path / "trainer.py")))
    yield job
    job.close()


def until(job: TrainingJob, condition: Callable[[JobStatus], bool]) -> JobStatus:
    for _ in range(3000):
        if condition(status := job.status()):
            return status
        time.sleep(0.01)
    raise AssertionError(f"never happened; last {status}")


def test_a_job_runs_stops_goes_on_and_ends(job: TrainingJob) -> None:
    assert job.status().state == "idle"
    job.start(JobConfig("toy/reach"))
    running = until(job, lambda status: len(status.rows) > 2)
    assert running.state == "running" and 0 < running.done < 1
    assert job.pid is not None and os.getpriority(os.PRIO_PROCESS, job.pid) == 19
    if sys.platform == "linux":
        assert os.sched_getscheduler(job.pid) == os.SCHED_IDLE
    with pytest.raises(UserError, match="running already"):
        job.start(JobConfig("toy/reach"))
    job.stop()
    stopped = until(job, lambda status: status.state == "stopped")
    assert "resume with: madviz train --resume" in training_html(stopped)
    job.resume()
    done = until(job, lambda status: status.state == "done")
    assert done.folder == stopped.folder and len(done.rows) == len(stopped.rows) + 2
    assert done.done == 1.0
    job.start(JobConfig("toy/reach"))
    assert job.status().folder != done.folder  # Nothing is written over.


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_signal_from_elsewhere_stops_a_job_or_fails_it(job: TrainingJob, number: int) -> None:
    job.start(JobConfig("toy/reach"))
    until(job, lambda status: len(status.rows) > 0)
    assert job.pid is not None
    os.kill(job.pid, number)
    ended = until(job, lambda status: status.state not in ("running", "stopping"))
    assert ended.state == ("stopped" if number == signal.SIGTERM else "failed")
    killed = "it was ended by SIGKILL, as a system does that has no memory left; go on resumes"
    assert (killed in training_html(ended)) == (number == signal.SIGKILL)
    job.resume()
    assert until(job, lambda status: status.state == "done").done == 1.0


def test_a_snapshot_is_a_copy_under_its_own_name(job: TrainingJob) -> None:
    with pytest.raises(UserError, match="policy to watch"):
        job.snapshot()
    job.start(JobConfig("toy/reach"))
    until(job, lambda status: status.ready and len(status.rows) > 1)
    copy = job.snapshot()
    assert copy.name in (copy / "config.json").read_text()
    assert "finished" not in (copy / "config.json").read_text()
    assert (copy / "weights.safetensors").read_bytes() == b"w"


def test_newer_weights_are_another_copy_and_the_same_weights_the_same(job: TrainingJob) -> None:
    """Also between two rows of the curve: what is being watched stays as it is."""
    job.start(JobConfig("toy/reach"))
    folder = until(job, lambda status: status.ready).folder
    assert folder is not None
    copies = [job.snapshot()]
    job.stop()
    until(job, lambda status: status.state == "stopped")
    copies.append(job.snapshot())
    (folder / "weights.safetensors").write_bytes(b"newer")
    copies.append(job.snapshot())
    weights = [(copy / "weights.safetensors").read_bytes() for copy in copies]
    assert weights == [b"w", b"w", b"newer"]
    assert copies[0] == copies[1] != copies[2] and len([*copies[0].parent.iterdir()]) == 2


def test_only_a_start_that_was_one_is_announced(job: TrainingJob, server) -> None:
    gui = recorded(server.gui)
    panel = TrainingPanel(gui, lambda _: None, frame_with(), job)
    use(gui.find("Task"), "toy/reach")
    assert [title for title, _ in use(gui.find("start"))] == ["Training"]
    assert [title for title, _ in use(gui.find("start"))] == ["That did not work"]
    panel.remove()


def test_why_a_job_failed_is_its_last_line(job: TrainingJob) -> None:
    job.start(JobConfig("toy/reach", "merged-only"))
    failed = until(job, lambda status: status.state == "failed")
    assert failed.why == "expected sugar, found salt; taste first"
    assert "taste first" in training_html(failed)


def test_closing_leaves_no_process(job: TrainingJob) -> None:
    job.start(JobConfig("toy/reach"))
    until(job, lambda status: len(status.rows) > 0)
    pid = job.pid
    assert pid is not None
    os.kill(pid, 0)
    job.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("metaworld/hamer",), "metaworld/hammer"),
        (("toy/reach", "sad"), "mad"),
        (("toy/reach", "mad", "heavy"), "light"),
        (("toy/reach", "mad", "light", "huge"), "trial"),
        (("toy/reach", "mad", "light; rm -rf /"), "light"),
    ],
)
def test_names_are_checked_before_anything_starts(names: tuple[str, ...], expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        JobConfig(*names)


def test_no_state_is_drawn_without_words() -> None:
    for state in ("idle", "running", "stopping", "stopped", "failed", "done"):
        status = JobStatus(state, JobConfig("toy/reach"), ({"loss": 0.5, "seconds": 1.0},))
        assert f'data-state="{state}"' in training_html(status)


@pytest.mark.slow
def test_a_real_training_can_be_watched(tmp_path: Path) -> None:
    job = TrainingJob(tmp_path)
    job.start(JobConfig("toy/reach", budget="trial"))
    try:
        for _ in range(600):
            status = job.status()
            assert status.state != "failed", status.why
            if status.state == "done":
                break
            time.sleep(0.5)
        assert status.state == "done" and len(status.rows) == 4
        watched = job.snapshot()
        assert load_policy(str(watched)).spec.name == watched.name
    finally:
        job.close()
