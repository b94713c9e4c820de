"""``madviz report --evaluate``: every policy with weights on seeds that nothing was developed on.

    before    evaluation.json  development seeds
    after     evaluation.json  reporting seeds      development.json  what evaluation.json was

Every finished episode is stored, and a policy's files change when all of its episodes are there. So
it can be stopped at any time, and goes on with the next episode. A policy that has the episodes
already is passed over.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from madviz.errors import Unfinished, UserError
from madviz.measure.evaluate import evaluate, write_measured
from madviz.measure.store import Store
from madviz.policies import checkpoint
from madviz.policies.again import RUNS
from madviz.policies.measured import EvaluationFile, seeds_of
from madviz.policies.seeds import FIRST_REPORTING, REPORTING
from madviz.recorded.known import is_recording
from madviz.system.streams import say

EPISODES = 100
STORE = Path(RUNS) / "reporting.sqlite"
"""Finished episodes; it can be removed once all policies are evaluated."""


def evaluate_all(folders: Sequence[Path], episodes: int, workers: int | None) -> list[Path]:
    """The policies that were evaluated, in order. ``episodes``: of each subset."""
    policies = sorted(file.parent for root in folders for file in root.rglob(checkpoint.WEIGHTS))
    STORE.parent.mkdir(parents=True, exist_ok=True)
    store = Store(STORE)
    try:
        return [path for path in policies if _evaluate(path, episodes, workers, store)]
    finally:
        store.close()


def _evaluate(path: Path, episodes: int, workers: int | None, store: Store) -> bool:
    """Whether the policy had to be evaluated; its files are new then."""
    try:
        if is_recording(checkpoint.describe(path).spec.task):
            say(f"{path}: left out, because recordings know no success")
            return False
        checkpoint.shipped_evaluation(path, checkpoint.DEVELOPMENT)
        before = checkpoint.shipped_evaluation(path)
    except UserError:
        return False  # A broken file; the report says so.
    if before is not None and seeds_of(before) == REPORTING and _least(before) >= episodes:
        return False
    say(f"{path}: {episodes} episodes of each subset")
    try:
        made = evaluate(
            path,
            None if before is None else before["subsets"],
            episodes=episodes,
            seed=FIRST_REPORTING,
            workers=workers,
            store=store,
            progress=True,
        )
    except Unfinished as stopped:  # What is done is in the store, for the next call.
        raise UserError(f"{path}: {stopped}") from stopped
    write_measured(path, made.to_json())
    return True


def _least(evaluation: EvaluationFile) -> int:
    """Episodes of the subset that has fewest."""
    return min((row["n"] for row in evaluation["subsets"].values()), default=0)
