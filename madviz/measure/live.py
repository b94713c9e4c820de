"""Success rates while a visitor of the page drops, occludes and moves cameras.

The page asks again and again; the answer is always what is known now. Three rules make the numbers
comparable and quick to come. At most one episode per worker is running, so a changed request starts
within one episode's time and does not wait behind the old one. Visitors take turns. And every
request gets the same seeds in the same order (5000, 5001, ...), so two rates can be compared;
episodes in the store count at once.

    request(visitor, ...) ─► wanted ─► next free worker ─► result ─► store, tally, listeners
                               ▲                             │
                               └───────── round robin ◄──────┘
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from madviz.errors import UserError
from madviz.measure.episodes import (
    FIRST_SEED,
    GIVE_UP,
    Finished,
    Job,
    Occlusions,
    Stopped,
    Workers,
    claimed_definition,
    relevant,
)
from madviz.measure.statistics import SuccessRate
from madviz.measure.store import EpisodeResult, Store
from madviz.observation.ablation import Occlusion
from madviz.observation.displacement import Displacement, Moves
from madviz.policies import checkpoint
from madviz.subsets import camera_of, name_of
from madviz.types import Array, PolicySpec

NICENESS = 15
"""Of worker processes: a visitor's own simulation goes first."""
MOST_REQUESTS = 1000
"""Requests whose episodes are remembered, besides those that are measured now: a slider that is
dragged makes many. What is stored is read again if somebody comes back to it."""


@dataclass(frozen=True)
class Request:
    """What is to be measured: a version of a policy, its present streams, and the cameras among
    them that are occluded or moved."""

    policy: str
    digest: str
    subset: str
    occlusions: Occlusions = ()
    moves: Moves = ()

    def job(self, seed: int) -> Job:
        """The episode ``seed`` of this request."""
        return Job(self.policy, self.digest, self.subset, self.occlusions, seed, self.moves)


def request_of(job: Job) -> Request:
    """What ``job`` is an episode of."""
    return Request(job.policy, job.digest, job.subset, job.occlusions, job.moves)


@dataclass(frozen=True)
class Tally:
    """What is known about a request so far; a snapshot that never changes."""

    request: Request
    results: tuple[EpisodeResult, ...] = ()
    """By seed, without gaps from the first on where nothing failed."""
    error: str = ""
    """Why no more episodes will come; empty while they do."""

    @property
    def n(self) -> int:
        """Episodes so far."""
        return len(self.results)

    @property
    def success(self) -> SuccessRate:
        """At the last step."""
        return SuccessRate.of(sum(result.success for result in self.results), self.n)

    @property
    def success_any(self) -> SuccessRate:
        """At any step."""
        return SuccessRate.of(sum(result.success_any for result in self.results), self.n)


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
        count = max((os.cpu_count() or 2) - 1, 1) if workers is None else workers
        self._workers = make_workers(count, NICENESS)
        self._store = store
        self._listener = listener
        self._seeds = range(FIRST_SEED, FIRST_SEED + episodes)
        self._lock = threading.RLock()
        self._wanted: dict[Hashable, Request] = {}
        """By visitor; the one whose turn is next comes first."""
        self._tallies: dict[Request, dict[int, EpisodeResult]] = {}
        self._errors: dict[Request, str] = {}
        self._specs: dict[Request, PolicySpec] = {}
        self._running: set[Job] = set()
        self._breaks, self._last_broken = 0, -1
        self._closed = False

    def request(
        self,
        visitor: Hashable,
        policy: str | Path,
        mask: Array,
        occlusions: dict[str, Occlusion] | None = None,
        moves: dict[str, Displacement] | None = None,
        digest: str | None = None,
    ) -> Tally:
        """From now on ``visitor`` wants this and nothing else. Returns what is known of it already.
        ``mask`` is (V,) bool, the streams that are present.

        Raises UserError for an unknown policy or camera, and for a policy that has another
        ``digest`` by now.
        """
        request = self._as_request(policy, mask, occlusions, moves, digest)
        with self._lock:
            if self._wanted.get(visitor) != request:
                self._errors.pop(request, None)  # Asking anew is trying anew.
                self._breaks = 0
                if visitor in self._wanted:
                    self._wanted[visitor] = request
                else:  # Newcomers are served first, then they queue.
                    self._wanted = {visitor: request, **self._wanted}
            self._fill()
            return self._tally(request)

    def tally(
        self, policy: str | Path, mask: Array, occlusions: dict[str, Occlusion] | None = None
    ) -> Tally:
        """What is known already of the streams ``mask`` (V,) bool, without measuring more."""
        request = self._as_request(policy, mask, occlusions)
        with self._lock:
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
            self._closed = True
            self._wanted.clear()
        self._workers.close()

    def _as_request(
        self,
        policy: str | Path,
        mask: Array,
        occlusions: dict[str, Occlusion] | None,
        moves: dict[str, Displacement] | None = None,
        digest: str | None = None,
    ) -> Request:
        """Requests that cannot differ are the same one. New ones start with what the store has."""
        reference = str(policy)
        if checkpoint.is_folder(reference):
            spec = checkpoint.describe(reference).spec
        else:
            spec = checkpoint.load_policy(reference).spec
        if digest not in (None, spec.digest):
            raise UserError(
                f"expected the weights that act here, found others in {reference}: it was changed "
                "meanwhile; reload the page to see and measure those"
            )
        present = relevant(occlusions or {}, mask, spec.streams)
        seen = {camera_of(s) for s, on in zip(spec.streams, mask, strict=True) if on}
        moved = tuple((c, move) for c, move in sorted((moves or {}).items()) if c in seen)
        request = Request(reference, spec.digest, name_of(mask, spec.streams), present, moved)
        with self._lock:
            if request not in self._tallies:
                self._specs[request] = spec
                self._tallies[request] = self._remembered(request, spec)
                self._forget_oldest()
            else:
                self._tallies[request] = self._tallies.pop(request)  # Now the newest one.
        return request

    def _forget_oldest(self) -> None:
        """Called with the lock held, when the newest request was added last."""
        busy = {request_of(job) for job in self._running} | set(self._wanted.values())
        idle = [request for request in self._tallies if request not in busy]
        for request in idle[:-MOST_REQUESTS]:
            del self._tallies[request], self._specs[request]
            self._errors.pop(request, None)

    def _remembered(self, request: Request, spec: PolicySpec) -> dict[int, EpisodeResult]:
        if self._store is None or not checkpoint.is_folder(request.policy):
            return {}
        key = request.job(0).key(spec, claimed_definition(request.policy))
        known = self._store.results(key)
        return {seed: known[seed] for seed in self._seeds if seed in known}

    def _tally(self, request: Request) -> Tally:
        results = sorted(self._tallies[request].items())
        return Tally(request, tuple(r for _, r in results), self._errors.get(request, ""))

    def _fill(self) -> None:
        """Gives every free worker the next episode; called with the lock held."""
        while not self._closed and len(self._running) < self._workers.count:
            job = next(self._turns(), None)
            if job is None:
                return
            self._running.add(job)
            future = self._workers.submit(job)
            generation = self._workers.generation
            future.add_done_callback(lambda f, j=job, g=generation: self._ended(j, g, f))

    def _turns(self) -> Iterator[Job]:
        """The next episode of the first visitor who lacks one; they then go to the end."""
        for visitor, request in list(self._wanted.items()):
            if request in self._errors:
                continue
            known = self._tallies[request]
            for seed in self._seeds:
                job = request.job(seed)
                if seed not in known and job not in self._running:
                    self._wanted[visitor] = self._wanted.pop(visitor)
                    yield job
                    return

    def _ended(self, job: Job, generation: int, future: Future[Finished]) -> None:
        """A job came to an end, with a result or an error; its worker is free again."""
        request = request_of(job)
        with self._lock:
            self._running.discard(job)
            if self._closed or future.cancelled():
                return
            error = future.exception()
            if error is None:
                try:
                    self._record(request, job, *future.result())
                except Exception as unstored:  # Measuring must not end without a word.
                    self._errors[request] = str(unstored) or type(unstored).__name__
            elif isinstance(error, BrokenProcessPool):
                self._replace(request, generation)
            elif not isinstance(error, Stopped):
                self._errors[request] = str(error) or type(error).__name__
            self._fill()
            tally = self._tally(request)
        if self._listener:
            self._listener(tally)

    def _record(self, request: Request, job: Job, result: EpisodeResult, definition: str) -> None:
        self._breaks = 0
        self._tallies[request][job.seed] = result
        if self._store is not None and checkpoint.is_folder(request.policy):
            self._store.put(job.key(self._specs[request], definition), result)

    def _replace(self, request: Request, generation: int) -> None:
        """The pool broke; the seed is free again, so the next turn takes it up."""
        if generation > self._last_broken:
            self._last_broken = generation
            self._breaks += 1
            self._workers.renew(generation)
        if self._breaks >= GIVE_UP:
            self._errors[request] = str(self._workers.gave_up())
