"""Twenty tasks, the target that a policy of each should meet, and what was tried on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from madviz.envs.registry import MANISKILL_TASKS, METAWORLD_TASKS
from madviz.errors import UserError, unknown
from madviz.evaluation.evidence import Evidence
from madviz.evaluation.statistics import SuccessRate
from madviz.report.layouts import THREE
from madviz.report.rows import Row
from madviz.report.tables import usual_alphas
from madviz.system.files import read_json
from madviz.system.typed import typed

TWENTY = (
    *(f"metaworld/{task}" for task in METAWORLD_TASKS),
    *(f"maniskill/{task}" for task in MANISKILL_TASKS),
)
TARGET_ALL, TARGET_MEAN, TARGET_EPISODES, TARGET_SEED = 0.92, 0.80, 100, 5000
"""A policy meets the target with these rates, on at least so many episodes from this seed on."""
TRIED = "tried.json"


@dataclass(frozen=True)
class Verdict:
    """Whether a task's policy meets the target."""

    task: str
    row: Row | None
    """None where no policy was trained and measured."""
    mean: SuccessRate | None
    reasons: tuple[str, ...]
    """What it falls short of; none: the target is met."""

    @property
    def words(self) -> str:
        """``met``, ``not met: ...`` with the reasons, or ``not trained``."""
        if self.row is None:
            return "not trained"
        return "met" if not self.reasons else f"not met: {'; '.join(self.reasons)}"


def judged_on(task: str) -> tuple[str, ...]:
    """The subsets of the mean; PokeCube's first person alone cannot see enough (paper)."""
    return tuple(c for c in THREE if task != "maniskill/poke-cube" or c != "first")


def judge(task: str, evidence: Sequence[Evidence]) -> Verdict:
    """The task's MAD policy on three cameras; of several, the one with the highest mean."""
    found = []
    for each in usual_alphas(evidence):
        if (each.task, each.method, each.setting, each.merge) == (task, "mad", "three", "sum"):
            row = Row(each.name, evidence=[each])
            for column in THREE:
                if outcomes := each.of(column):
                    row.cells[column] = {(task, each.seed, s): ok for s, ok in outcomes.items()}
            if mean := row.mean(judged_on(task)):
                found.append((mean.value, row))
    if not found:
        return Verdict(task, None, None, ())
    row = max(found, key=lambda each: each[0])[1]
    mean = row.mean(judged_on(task))
    return Verdict(task, row, mean, tuple(_reasons(task, row, mean)))


def _reasons(task: str, row: Row, mean: SuccessRate | None) -> list[str]:
    reasons = []
    missing = [c for c in judged_on(task) if c not in row.cells]
    if missing:
        reasons.append(f"{', '.join(missing)} not measured")
    whole = row.rate("all")
    if whole is not None and whole.value < TARGET_ALL:
        reasons.append(f"all {whole.value:.2f} is below {TARGET_ALL}")
    if mean is not None and mean.value < TARGET_MEAN:
        reasons.append(f"mean {mean.value:.2f} is below {TARGET_MEAN:.2f}")
    if mean is not None and mean.n < TARGET_EPISODES:
        reasons.append(f"{mean.n} episodes, {TARGET_EPISODES} are needed")
    if row.evidence[0].first_seed < TARGET_SEED:
        reasons.append(f"seeds below {TARGET_SEED}")
    return reasons


def tried(folder: Path) -> dict[str, list[str]]:
    """What was tried, in the order of the twenty tasks; empty without the file. Raises UserError
    for a file of another form."""
    path = folder / TRIED
    if not path.exists():
        return {}
    fix = f'list sentences for each task: {{"{TWENTY[0]}": ["12 rounds: all 0.90"]}}'
    found = typed(read_json(path), dict[str, list[str]], path, fix)
    for task in found:
        if task not in TWENTY:
            raise UserError(f"{path}: {unknown('task', task, list(TWENTY))}")
    return {task: found[task] for task in TWENTY if found.get(task)}


def verdict_json(verdict: Verdict) -> dict[str, Any]:
    """For ``--json``: the policy's folder, its rates with n and interval, the verdict."""
    subsets = {} if verdict.row is None else {c: verdict.row.rate(c) for c in THREE}
    rated = {**subsets, "mean": verdict.mean}
    return {
        "task": verdict.task,
        "policy": None if verdict.row is None else str(verdict.row.evidence[0].path),
        "verdict": verdict.words,
        **{
            name: {"success": rate.value, "n": rate.n, "ci95": list(rate.interval)}
            for name, rate in rated.items()
            if rate is not None
        },
    }
