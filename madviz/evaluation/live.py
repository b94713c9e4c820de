"""Success rates while somebody plays with the cameras: episodes under the setting of this moment.

The page asks again and again, the answer is always what is known now. Three rules keep that honest
and quick. At most one episode per worker is in flight, so a changed setting is served within one
episode's time, not behind a queue of the old one. Visitors take turns. And every setting gets the
same seeds in the same order (5000, 5001, ...), so bars of two settings can be compared; what the
store knows from earlier days is there at once.

    request(visitor, setting) ─► wanted ─► next free worker ─► result ─► store, tally, listeners
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

from madviz.evaluation.episodes import (
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
from madviz.evaluation.statistics import Interval, wilson
from madviz.evaluation.store import EpisodeResult, Store
from madviz.observation.ablation import Occlusion
from madviz.observation.displacement import Displacement, Moves
from madviz.policies import checkpoint
from madviz.subsets import camera_of, name_of
from madviz.types import Array, PolicySpec

NICENESS = 15
"""Of worker processes: a visitor's own simulation goes first."""


@dataclass(frozen=True)
class Setting:
    """What is evaluated: a version of a policy, the present streams, what is wrong with them."""

    policy: str
    digest: str
    subset: str
    occlusions: Occlusions = ()
    moves: Moves = ()

    def job(self, seed: int) -> Job:
        return Job(self.policy, self.digest, self.subset, self.occlusions, seed, self.moves)


@dataclass(frozen=True)
class Tally:
    """What is known about a setting so far; a snapshot that never changes."""

    setting: Setting
    results: tuple[EpisodeResult, ...] = ()
    """By seed, without gaps from the first on where nothing failed."""
    error: str = ""
    """Why no more episodes will come; '' while all is well."""

    @property
    def n(self) -> int:
        return len(self.results)

    @property
    def successes(self) -> int:
        """At the last step."""
        return sum(result.success for result in self.results)

    @property
    def success(self) -> float:
        """The rate; NaN before the first episode."""
        return self.successes / self.n if self.n else float("nan")

    @property
    def success_any(self) -> float:
        """The rate at any step; NaN before the first episode."""
        return sum(r.success_any for r in self.results) / self.n if self.n else float("nan")

    @property
    def ci95(self) -> Interval:
        return wilson(self.successes, self.n)


class Evaluator:
    """One for all visitors of a page; every method may be called from any thread.

    Processes start at the first request and are replaced when they die. ``listener`` hears of every
    new tally, on a thread of its own: it must be quick, and may call back.
    """

    def __init__(
        self,
        workers: int | None = None,
        store: Store | None = None,
        listener: Callable[[Tally], None] | None = None,
        episodes: int = 100,
        make_workers: Callable[[int, int], Workers] = Workers,
    ) -> None:
        """``workers`` None leaves one core to the page. ``episodes`` is enough for a setting."""
        count = max((os.cpu_count() or 2) - 1, 1) if workers is None else workers
        self._workers = make_workers(count, NICENESS)
        self._store = store
        self._listener = listener
        self._seeds = range(FIRST_SEED, FIRST_SEED + episodes)
        self._lock = threading.RLock()
        self._wanted: dict[Hashable, Setting] = {}
        """By visitor; the one whose turn is next comes first."""
        self._tallies: dict[Setting, dict[int, EpisodeResult]] = {}
        self._errors: dict[Setting, str] = {}
        self._specs: dict[Setting, PolicySpec] = {}
        self._flying: set[Job] = set()
        self._breaks, self._last_broken = 0, -1
        self._closed = False

    def request(
        self,
        visitor: Hashable,
        policy: str | Path,
        mask: Array,
        occlusions: dict[str, Occlusion] | None = None,
        moves: dict[str, Displacement] | None = None,
    ) -> Tally:
        """From now on ``visitor`` wants this and nothing else; what is known of it already.

        Raises UserError for an unknown policy or camera.
        """
        setting = self._setting(policy, mask, occlusions, moves)
        with self._lock:
            if self._wanted.get(visitor) != setting:
                self._errors.pop(setting, None)  # Asking anew is trying anew.
                self._breaks = 0
                if visitor in self._wanted:
                    self._wanted[visitor] = setting
                else:  # Newcomers are served first, then they queue.
                    self._wanted = {visitor: setting, **self._wanted}
            self._fill()
            return self._tally(setting)

    def tally(
        self, policy: str | Path, mask: Array, occlusions: dict[str, Occlusion] | None = None
    ) -> Tally:
        """What is known of a setting, without wanting more of it."""
        setting = self._setting(policy, mask, occlusions)
        with self._lock:
            return self._tally(setting)

    def forget(self, visitor: Hashable) -> None:
        """The visitor is gone; an episode in flight ends and is kept."""
        with self._lock:
            self._wanted.pop(visitor, None)

    def close(self) -> None:
        """Ends the processes; what is in flight is abandoned."""
        with self._lock:
            self._closed = True
            self._wanted.clear()
        self._workers.close()

    def _setting(
        self,
        policy: str | Path,
        mask: Array,
        occlusions: dict[str, Occlusion] | None,
        moves: dict[str, Displacement] | None = None,
    ) -> Setting:
        """Settings that cannot differ are the same one. New ones start with what the store has."""
        reference = str(policy)
        if checkpoint.is_folder(reference):
            spec = checkpoint.describe(reference).spec
        else:
            spec = checkpoint.load_policy(reference).spec
        present = relevant(occlusions or {}, mask, spec.streams)
        seen = {camera_of(s) for s, on in zip(spec.streams, mask, strict=True) if on}
        moved = tuple((c, move) for c, move in sorted((moves or {}).items()) if c in seen)
        setting = Setting(reference, spec.digest, name_of(mask, spec.streams), present, moved)
        with self._lock:
            if setting not in self._tallies:
                self._specs[setting] = spec
                self._tallies[setting] = self._remembered(setting, spec)
        return setting

    def _remembered(self, setting: Setting, spec: PolicySpec) -> dict[int, EpisodeResult]:
        if self._store is None or not checkpoint.is_folder(setting.policy):
            return {}
        key = setting.job(0).key(spec, claimed_definition(setting.policy))
        known = self._store.results(key)
        return {seed: known[seed] for seed in self._seeds if seed in known}

    def _tally(self, setting: Setting) -> Tally:
        results = sorted(self._tallies[setting].items())
        return Tally(setting, tuple(r for _, r in results), self._errors.get(setting, ""))

    def _fill(self) -> None:
        """Gives every free worker the next episode; called with the lock held."""
        while not self._closed and len(self._flying) < self._workers.count:
            job = next(self._turns(), None)
            if job is None:
                return
            self._flying.add(job)
            future = self._workers.submit(job)
            generation = self._workers.generation
            future.add_done_callback(lambda f, j=job, g=generation: self._landed(j, g, f))

    def _turns(self) -> Iterator[Job]:
        """The next episode of the first visitor who lacks one; they then go to the end."""
        for visitor, setting in list(self._wanted.items()):
            if setting in self._errors:
                continue
            known = self._tallies[setting]
            for seed in self._seeds:
                job = setting.job(seed)
                if seed not in known and job not in self._flying:
                    self._wanted[visitor] = self._wanted.pop(visitor)
                    yield job
                    return

    def _landed(self, job: Job, generation: int, future: Future[Finished]) -> None:
        """A worker is free again, for better or worse."""
        setting = Setting(job.policy, job.digest, job.subset, job.occlusions, job.moves)
        with self._lock:
            self._flying.discard(job)
            if self._closed or future.cancelled():
                return
            error = future.exception()
            if error is None:
                self._keep(setting, job, *future.result())
            elif isinstance(error, BrokenProcessPool):
                self._replace(setting, generation)
            elif not isinstance(error, Stopped):
                self._errors[setting] = str(error) or type(error).__name__
            self._fill()
            tally = self._tally(setting)
        if self._listener:
            self._listener(tally)

    def _keep(self, setting: Setting, job: Job, result: EpisodeResult, definition: str) -> None:
        self._breaks = 0
        self._tallies[setting][job.seed] = result
        if self._store is not None and checkpoint.is_folder(setting.policy):
            self._store.put(job.key(self._specs[setting], definition), result)

    def _replace(self, setting: Setting, generation: int) -> None:
        """The pool broke; the seed is free again, so the next turn takes it up."""
        if generation > self._last_broken:
            self._last_broken = generation
            self._breaks += 1
            self._workers.renew(generation)
        if self._breaks >= GIVE_UP:
            self._errors[setting] = str(self._workers.gave_up())
