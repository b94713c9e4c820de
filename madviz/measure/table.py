"""The table of a policy's episodes: a result for each condition and seed.

Everything that measures is a view of such a table: ``eval`` asks for camera subsets, ``compare
--conditions`` for other conditions, ``audit`` for those it needs next, the page
for what its visitors look at. A table grows, and is kept in a store (``store.py``) if it gets one:
what is there is not played again, so whatever was stopped goes on where it was.

    table, policy = Table.opened("metaworld-hammer-mad-light", store)
    table.play([(Condition("all"), seed) for seed in range(5000, 5100)], workers=None)
    table.outcomes(Condition("all"))        {5000: True, 5001: True, ...}
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from madviz.errors import UserError
from madviz.measure.episodes import Finished, Job, Runner
from madviz.measure.store import EpisodeResult, ResultKey, Store
from madviz.measure.workers import Workers, run_anywhere
from madviz.observation.condition import Condition
from madviz.policies import checkpoint
from madviz.recorded.known import refuse_recording
from madviz.types import Policy, PolicySpec


def seeds_of_run(first: int, episodes: int) -> range:
    """The seeds of ``episodes`` from ``first`` on. Raises UserError for numbers that are none."""
    if episodes < 1 or first < 0:
        raise UserError(f"expected episodes >= 1 and seed >= 0, found {episodes} and {first}")
    return range(first, first + episodes)


class Table:
    """See the module."""

    def __init__(
        self, reference: str, spec: PolicySpec, store: Store | None = None, own: bool = False
    ) -> None:
        """``reference`` is what ``load_policy`` knows the policy by, '' for an object.

        ``store`` is a cache for all policies, which keeps episodes of policy folders only: whether
        a user's own code is still the same cannot be known. An ``own`` store belongs to this table
        alone, so it keeps all of them.
        """
        folder = bool(reference) and checkpoint.is_folder(reference)
        self.reference = reference
        self.spec = spec
        self.kept = ""
        """A folder for what episodes look like, where they have to be kept (``watched.py``)."""
        self.definition = ""
        """The task's definition of a success; known with the first episode."""
        self.runner = Runner()
        """Plays episodes in this process."""
        self._store = store if folder or own else None
        self._own = own
        self._claimed = checkpoint.describe(reference).config.definition if folder else ""
        self._results: dict[Condition, dict[int, EpisodeResult]] = {}

    @staticmethod
    def opened(
        policy: str | Path | Policy, store: Store | None = None, own: bool = False
    ) -> tuple[Table, Policy]:
        """The table of ``policy``, and the policy itself, loaded. Raises UserError for an unknown
        one."""
        if isinstance(policy, str | Path):
            reference = str(policy)
            loaded = checkpoint.load_policy(policy)
        else:
            reference = ""
            loaded = policy
        refuse_recording(loaded.spec.task, "counting successes")
        table = Table(reference, loaded.spec, store, own)
        table.runner.adopt(reference, loaded)
        return table, loaded

    def results(self, condition: Condition) -> dict[int, EpisodeResult]:
        """All known episodes of ``condition``, by seed; the store is read at the first call."""
        if condition not in self._results:
            stored = {}
            if self._store is not None:
                stored = self._store.results(self._key(condition, self._claimed))
            if stored:
                self.definition = self.definition or self._claimed
            self._results[condition] = stored
        return self._results[condition]

    def outcomes(self, condition: Condition) -> dict[int, bool]:
        """Success at the last step, by seed."""
        return {seed: result.success for seed, result in self.results(condition).items()}

    def outside(self, conditions: Iterable[Condition]) -> float:
        """The share of action numbers outside [-1, 1] in all known episodes of ``conditions``."""
        shares = [r.outside for c in conditions for r in self.results(c).values()]
        return sum(shares) / max(len(shares), 1)

    def job(self, condition: Condition, seed: int) -> Job:
        """The episode ``seed`` of ``condition``, to be run."""
        return Job(self.reference, self.spec.digest, condition, seed, self.kept)

    def add(self, job: Job, finished: Finished) -> None:
        """Takes the result of a job, and stores it."""
        result, definition = finished
        self.definition = self.definition or definition
        self.results(job.condition)[job.seed] = result
        if self._store is not None:
            key = self._key(job.condition, self._claimed if self._own else definition)
            self._store.put(key, result)

    def play(
        self,
        wanted: Iterable[tuple[Condition, int]],
        workers: int | None | Workers,
        progress: bool = False,
    ) -> None:
        """Plays the episodes ``wanted`` (condition and seed) that are not there yet, and keeps each
        as it finishes. ``workers`` and ``progress`` as in ``run_anywhere``. Raises UserError where
        a policy or a machine fails; what is done by then is there."""
        missing = [(c, seed) for c, seed in wanted if seed not in self.results(c)]
        jobs = [self.job(condition, seed) for condition, seed in dict.fromkeys(missing)]
        for job, finished in run_anywhere(jobs, workers, self.runner, progress):
            self.add(job, finished)

    def _key(self, condition: Condition, definition: str) -> ResultKey:
        return ResultKey(
            digest=self.spec.digest or (f"of {self.reference}" if self._own else ""),
            task=self.spec.task,
            definition=definition,
            render_profile=self.spec.render_profile,
            occlusions=condition.key(),
            subset=condition.subset,
        )
