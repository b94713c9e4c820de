"""Success rates while a visitor of the page drops, occludes and moves cameras.

The page asks again and again; the answer is always what is known now. Three rules make the numbers
comparable and quick to come. At most one episode per worker is running, so a changed request starts
within one episode's time and does not wait behind the old one. Visitors take turns. And every
request gets the same seeds in the same order (60000, 60001, ...), so two rates can be compared;
episodes in the store count at once. An episode counts when all before it are done, so that several
workers count no quick episodes in place of slow ones.

    request(visitor, ...) ─► wanted ─► next free worker ─► result ─► table, store, listeners
                               ▲                             │
                               └───────── round robin ◄──────┘
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from madviz.errors import UserError
from madviz.measure.episodes import FIRST_SEED, Finished, Job, Stopped
from madviz.measure.store import EpisodeResult, Store
from madviz.measure.table import Table
from madviz.measure.workers import Pool, Workers
from madviz.observation.condition import Condition
from madviz.policies import checkpoint
from madviz.system.machine import cores
from madviz.types import PolicySpec

NICENESS = 15
"""The niceness of worker processes: a visitor's own simulation goes first."""
MOST_REQUESTS = 1000
"""Requests whose episodes are remembered, besides those that are measured now: a slider that is
dragged makes many. What is stored is read again if somebody comes back to it."""


class Request(NamedTuple):
    """A condition to be measured, and a version of a policy."""

    policy: str
    digest: str
    condition: Condition


@dataclass(frozen=True)
class Tally:
    """The results of a request so far; a snapshot that never changes."""

    request: Request
    results: tuple[EpisodeResult, ...] = ()
    """By seed, without gaps from the first on."""
    error: str = ""
    """Why no more episodes will come; empty while they do."""


class Evaluator:
    """One for all visitors of a page; every method may be called from any thread.

    Processes start at the first request and are replaced when they die. ``listener`` is called
    with every new tally, on a thread of its own: it must be quick, and may call back.
    """

    def __init__(
        self,
        workers: int | None = None,
        store: Store | None = None,
        listener: Callable[[Tally], None] | None = None,
        episodes: int = 100,
        make_workers: Callable[[int, int], Workers] = Workers,
    ) -> None:
        """``workers`` None leaves one core to the page. ``episodes`` is enough for a request."""
        count = max(cores() - 1, 1) if workers is None else workers
        self._pool = Pool(make_workers(count, NICENESS), self._next_job, self._ended, self._tell)
        self._lock = self._pool.lock
        self._store = store
        self._listener = listener
        self._seeds = range(FIRST_SEED, FIRST_SEED + episodes)
        self._wanted: dict[Hashable, Request] = {}
        """By visitor; the one whose turn is next comes first."""
        self._tables: dict[Request, Table] = {}
        """A table for each request, the newest last."""
        self._errors: dict[Request, str] = {}

    def request(
        self,
        visitor: Hashable,
        policy: str | Path,
        condition: Condition,
        spec: PolicySpec | None = None,
    ) -> Tally:
        """From now on ``visitor`` wants this and nothing else. Returns what is known of it already.

        Raises UserError for an unknown policy or camera, and for a folder that holds other weights
        than ``spec`` by now. A policy that is no folder is loaded here, unless its ``spec`` is
        given; then the worker that loads it compares.
        """
        request = self._as_request(policy, condition, spec)
        with self._lock:
            if self._wanted.get(visitor) != request:
                self._errors.pop(request, None)  # Asking anew is trying anew.
                self._pool.forget_deaths()
                if visitor in self._wanted:
                    self._wanted[visitor] = request
                else:  # Newcomers are served first, then they queue.
                    self._wanted = {visitor: request, **self._wanted}
            self._pool.fill()
            return self._tally(request)

    @property
    def trouble(self) -> str:
        """Why what is measured is gone when the page ends; '' where it is stored."""
        return "" if self._store is None else self._store.trouble

    def forget(self, visitor: Hashable) -> None:
        """The visitor has left; an episode that is running ends and counts."""
        with self._lock:
            self._wanted.pop(visitor, None)

    def close(self) -> None:
        """Ends the processes; running episodes are abandoned."""
        with self._lock:
            self._wanted.clear()
        self._pool.close()

    def _as_request(
        self, policy: str | Path, condition: Condition, acting: PolicySpec | None = None
    ) -> Request:
        """Requests that cannot differ are the same one. New ones start with what the store has."""
        reference = str(policy)
        if checkpoint.is_folder(reference):
            spec = checkpoint.describe(reference).spec
        else:
            spec = acting or checkpoint.load_policy(reference).spec
        if acting is not None and acting.digest != spec.digest:
            raise UserError(
                f"expected the weights that act here, found others in {reference}: it was changed "
                "meanwhile; reload the page to see and measure those"
            )
        request = Request(reference, spec.digest, condition.noticed(spec.streams))
        with self._lock:
            table = self._tables.pop(request, None) or Table(reference, spec, self._store)
            self._tables[request] = table  # Now the newest one.
            self._forget_oldest()
        return request

    def _forget_oldest(self) -> None:
        """Called with the lock held, when the newest request was added last."""
        busy = {_request_of(job) for job in self._pool.running} | set(self._wanted.values())
        idle = [request for request in self._tables if request not in busy]
        for request in idle[:-MOST_REQUESTS]:
            del self._tables[request]
            self._errors.pop(request, None)

    def _tally(self, request: Request) -> Tally:
        known = self._tables[request].results(request.condition)
        done = takewhile(known.__contains__, self._seeds)
        results = tuple(known[seed] for seed in done)
        return Tally(request, results, self._errors.get(request, ""))

    def _next_job(self) -> Job | None:
        """The next episode of the first visitor who lacks one; they then go to the end. Called by
        the pool, which holds the lock."""
        for visitor, request in self._wanted.items():
            if request in self._errors:
                continue
            table = self._tables[request]
            known = table.results(request.condition)
            for seed in self._seeds:
                job = table.job(request.condition, seed)
                if seed not in known and job not in self._pool.running:
                    self._wanted[visitor] = self._wanted.pop(visitor)
                    return job
        return None

    def _ended(self, job: Job, outcome: Finished | BaseException) -> None:
        """Records how a job ended. Called by the pool, which holds the lock."""
        request = _request_of(job)
        if isinstance(outcome, Stopped):
            return
        try:
            if isinstance(outcome, BaseException):
                raise outcome
            self._tables[request].add(job, outcome)
        except Exception as error:  # Also of the store: measuring must not end without a word.
            self._errors[request] = str(error) or type(error).__name__

    def _tell(self, job: Job) -> None:
        """Calls the listener. Called by the pool, which does not hold the lock."""
        if self._listener:
            with self._lock:
                tally = self._tally(_request_of(job))
            self._listener(tally)


def _request_of(job: Job) -> Request:
    return Request(job.policy, job.digest, job.condition)
