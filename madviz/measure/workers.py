"""Processes that run episodes, and the pool that keeps them busy.

OpenGL and PyTorch do not survive a fork, so workers are spawned and load what they need themselves.

A process dies now and then (out of memory, killed by a user). The standard library then gives up
all of them. ``Pool`` starts new ones and hands out the same jobs again. An episode lasts seconds,
so that is all that is lost.
"""

from __future__ import annotations

import multiprocessing
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from queue import SimpleQueue
from typing import Any

from tqdm import tqdm

from madviz.errors import UserError
from madviz.measure.episodes import Finished, Job, Runner
from madviz.measure.watched import carry_out
from madviz.system.machine import cores
from madviz.system.processes import set_up_worker

GIVE_UP = 3
"""How often all processes may die in a row, without an episode finished, before it is an error."""


class Workers:
    """``count`` processes that run jobs; started at the first one, replaced when they die."""

    def __init__(self, count: int, niceness: int = 0) -> None:
        if count < 1:
            raise UserError(f"expected one worker process or more, found {count}")
        self.count = count
        self._niceness = niceness
        self._context = multiprocessing.get_context("spawn")
        # Shared memory without a lock: a worker that is killed cannot leave it locked.
        self._stop = self._context.RawValue("b", 0)
        self._pool: ProcessPoolExecutor | None = None
        self.generation = 0
        """Counts the pools; a job knows from which one it came."""

    def submit(self, job: Job) -> Future[Finished]:
        """Starts a job as soon as a process is free. Its result may be BrokenProcessPool."""
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                self.count, self._context, _start, (self._stop, self._niceness)
            )
        try:
            return self._pool.submit(_work, job)
        except BrokenProcessPool:  # It broke since it was last asked.
            self.renew(self.generation)
            return self.submit(job)

    def renew(self, generation: int) -> None:
        """Forgets the broken pool of ``generation``, unless that has happened already.

        It is not shut down: a broken pool ends its processes by itself, and completes its futures
        while it holds the lock that ``shutdown`` would wait for.
        """
        if generation == self.generation:
            self._pool = None
            self.generation += 1

    def gave_up(self) -> UserError:
        """The error after ``GIVE_UP`` deaths in a row."""
        return UserError(
            f"expected worker processes to live, found {GIVE_UP} deaths in a row without a "
            "finished episode; out of memory? try --workers 1, or 0 to see the error in this "
            "process (a script needs `if __name__ == '__main__':` around what it runs)"
        )

    def close(self) -> None:
        """Abandons what runs at its next decision, and what waits."""
        self._stop.value = 1
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = None


def processes(workers: int | None) -> int:
    """How many processes ``workers`` asks for, by default one per core."""
    return cores() if workers is None else workers


Ended = Callable[[Job, "Finished | BaseException"], None]
"""Called with a job and its result, or with the error that ended it."""


class Pool:
    """Keeps ``workers`` busy: each gets another job as soon as it is free.

    Jobs come from ``next_job``, None where there is none now. ``ended`` hears of each one that is
    over, ``after`` as well, when the next jobs have been handed out. ``lock`` is held while
    ``next_job`` and ``ended`` are called, and not while ``after`` is. A job whose process died is
    handed out again, until processes have died ``GIVE_UP`` times without an episode in between.
    """

    def __init__(
        self,
        workers: Workers,
        next_job: Callable[[], Job | None],
        ended: Ended,
        after: Callable[[Job], None] = lambda job: None,
    ) -> None:
        self.lock = threading.RLock()
        self.running: set[Job] = set()
        self._workers = workers
        self._next_job = next_job
        self._ended = ended
        self._after = after
        self._deaths = 0
        self._last_broken = -1
        """The newest generation of processes that is known to be dead."""
        self._filling = False
        self._closed = False

    def fill(self) -> None:
        """Gives every free worker a job."""
        with self.lock:
            if self._filling:  # A job ended while it was handed out: the loop below goes on.
                return
            self._filling = True
            try:
                while not self._closed and len(self.running) < self._workers.count:
                    job = self._next_job()
                    if job is None:
                        return
                    self._hand_out(job)
            finally:
                self._filling = False

    def forget_deaths(self) -> None:
        """Forgets how often processes died: the next jobs are others."""
        with self.lock:
            self._deaths = 0

    def close(self) -> None:
        """Abandons what runs at its next decision; nothing is heard of it."""
        with self.lock:
            self._closed = True
        self._workers.close()

    def _hand_out(self, job: Job) -> None:
        self.running.add(job)
        try:
            future = self._workers.submit(job)
        except Exception as error:  # No process could be started: the job ends with that error.
            future = Future()
            future.set_exception(error)
        generation = self._workers.generation
        future.add_done_callback(lambda done: self._came(job, generation, done))

    def _came(self, job: Job, generation: int, future: Future[Finished]) -> None:
        """Takes the end of a job, on a thread of the executor."""
        with self.lock:
            self.running.discard(job)
            if self._closed or future.cancelled():
                return
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                if generation > self._last_broken:  # All jobs of a generation break together.
                    self._last_broken = generation
                    self._deaths += 1
                    self._workers.renew(generation)
                if self._deaths < GIVE_UP:
                    self._hand_out(job)
                    return
                error = self._workers.gave_up()
            elif error is None:
                self._deaths = 0
            self._ended(job, future.result() if error is None else error)
            self.fill()
        self._after(job)


def run_jobs(
    jobs: list[Job], workers: Workers, keep: bool = False
) -> Iterator[tuple[Job, Finished]]:
    """Every job with its result, as they finish, in no order. Closes ``workers`` at the end, unless
    they are to ``keep`` and all jobs are done.

    Raises UserError if processes keep dying, and whatever a job raises.
    """
    waiting = deque(dict.fromkeys(jobs))
    count = len(waiting)
    ended: SimpleQueue[tuple[Job, Finished | BaseException]] = SimpleQueue()
    pool = Pool(
        workers,
        lambda: waiting.popleft() if waiting else None,
        lambda job, outcome: ended.put((job, outcome)),
    )
    try:
        pool.fill()
        for _ in range(count):
            job, outcome = ended.get()
            if isinstance(outcome, BaseException):
                raise outcome
            yield job, outcome
            count -= 1
    finally:
        if count or not keep:
            pool.close()


def run_anywhere(
    jobs: list[Job], workers: int | None | Workers, here: Runner, progress: bool
) -> Iterator[tuple[Job, Finished]]:
    """Every job with its result, in no order: by ``workers`` processes, by default one per core; or
    in this one, ``here``, where it is 0 or the policy is an object. Closes ``here`` at the end, and
    leaves processes that it was given. ``progress`` shows a bar on standard error, if that is a
    terminal."""
    keep = isinstance(workers, Workers)
    count = workers.count if isinstance(workers, Workers) else processes(workers)
    if any(not job.policy for job in jobs):
        count = 0
    results: Iterator[tuple[Job, Finished]] = ((job, carry_out(job, here)) for job in jobs)
    if count and jobs:
        if not isinstance(workers, Workers):
            workers = Workers(min(count, len(jobs)), niceness=5)
        results = run_jobs(jobs, workers, keep)
    try:
        yield from tqdm(
            results, total=len(jobs), unit="episode", disable=None if progress else True
        )
    finally:
        here.close()


# --- In a worker process ----------------------------------------------------------------------


_runner: Runner
"""The process keeps it between jobs."""


def _start(stop: Any, niceness: int) -> None:
    """Runs once in a new process."""
    global _runner
    set_up_worker(niceness)
    _runner = Runner(lambda: bool(stop.value))


def _work(job: Job) -> Finished:
    return carry_out(job, _runner)
