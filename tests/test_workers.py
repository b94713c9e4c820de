"""Worker processes that are killed, or whose parent is. They are real; the environment is toy."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from madviz.errors import UserError
from madviz.measure.episodes import Job, Runner
from madviz.measure.evaluate import evaluate
from madviz.measure.workers import Workers, run_jobs
from madviz.observation.condition import Condition
from tests.fakes import FakePolicy


class Killing(FakePolicy):
    """Kills its process."""

    def encode(self, views, state):
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("unreachable")


def jobs_for(count, subset="all"):
    policy = "tests.fakes:FakePolicy"
    return [Job(policy, "toy-mad0", Condition(subset), seed) for seed in range(5000, 5000 + count)]


def test_a_killed_worker_is_replaced_and_nothing_finished_is_lost():
    jobs, workers, before = jobs_for(40), Workers(2), set(multiprocessing.active_children())
    finished = run_jobs(jobs, workers)
    seen = [next(finished) for _ in range(5)]
    victim = next(iter(set(multiprocessing.active_children()) - before))
    assert victim.pid is not None
    os.kill(victim.pid, signal.SIGKILL)
    seen += list(finished)
    assert workers.generation >= 1
    assert sorted(job.seed for job, _ in seen) == [job.seed for job in jobs]  # Each exactly once.
    serial = Runner()
    assert dict(seen) == {job: serial.run(job) for job in jobs}


def test_workers_are_gone_when_the_last_episode_is_there():
    before = set(multiprocessing.active_children())
    evaluate("tests.fakes:FakePolicy", ("all",), episodes=2, workers=1)
    assert set(multiprocessing.active_children()) <= before


def test_a_policy_that_kills_every_worker_is_given_up():
    with pytest.raises(UserError, match="3 deaths in a row.*--workers"):
        evaluate("tests.test_workers:Killing", ("all",), episodes=2, workers=1)


def test_workers_end_when_their_parent_is_killed():
    code = (
        "import multiprocessing, time; from madviz.measure.workers import Job, Workers\n"
        "from madviz.observation.condition import Condition\n"
        "workers = Workers(1)\n"
        "job = Job('tests.fakes:FakePolicy', 'toy-mad0', Condition('all'), 1)\n"
        "workers.submit(job).result()\n"
        "print(*(c.pid for c in multiprocessing.active_children()), flush=True); time.sleep(600)"
    )
    words = [sys.executable, "-c", code]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        children = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(children) == 1
        parent.kill()
    deadline = time.monotonic() + 5
    while any(alive(pid) for pid in children) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in children)


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


class Asked(FakePolicy):
    """Says how its process was set up, as an error."""

    def encode(self, views, state):
        raise UserError(f"threads {os.environ['LP_NUM_THREADS']}, niceness {os.nice(0)}")


def test_workers_use_one_thread_and_a_low_priority():
    workers = Workers(1, niceness=7)
    job = replace(jobs_for(1)[0], policy="tests.test_workers:Asked")
    with pytest.raises(UserError, match=f"threads 1, niceness {min(os.nice(0) + 7, 19)}"):
        workers.submit(job).result()
    workers.close()
