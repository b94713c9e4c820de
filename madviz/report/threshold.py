"""Twenty tasks, and the acceptance threshold that a task's policy has to meet.

The threshold says when a policy is good enough to be shown. With all cameras it hardly ever fails,
so that a failure after a camera was dropped comes from the camera. The mean is over all cameras and
each one alone, and not one limit for every camera: a camera may not show what decides. A policy can
therefore pass with a weak camera; those are named (``weak``). A hundred episodes make the 95%
interval of a rate at most 0.2 wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from madviz.envs.registry import MANISKILL_TASKS, METAWORLD_TASKS
from madviz.measure.evidence import Evidence
from madviz.measure.statistics import SuccessRate
from madviz.policies.seeds import DEVELOPMENT, READ, TRY
from madviz.report.layouts import THREE
from madviz.report.rows import Row
from madviz.report.tables import row_of, usual_alphas

TWENTY = (
    *(f"metaworld/{task}" for task in METAWORLD_TASKS),
    *(f"maniskill/{task}" for task in MANISKILL_TASKS),
)
LEAST_ALL = 0.92
LEAST_MEAN = 0.80
LEAST_EPISODES = 100
"""A policy meets the threshold with these rates, on at least so many episodes of each subset."""
WEAK = 0.70
"""A single camera below this success rate is weak."""


@dataclass(frozen=True)
class Verdict:
    """Whether a task's policy meets the threshold."""

    task: str
    row: Row | None
    """None where no policy was trained and measured."""
    mean: SuccessRate | None
    reasons: tuple[str, ...]
    """The requirements that it misses; none: the threshold is met."""

    @property
    def words(self) -> str:
        """``met``, ``not met: ...`` with the reasons, or ``not trained``."""
        if self.row is None:
            return "not trained"
        return "met" if not self.reasons else f"not met: {'; '.join(self.reasons)}"

    @property
    def weak(self) -> dict[str, SuccessRate]:
        """Single cameras below ``WEAK``."""
        rates = {c: self.row.rate(c) for c in THREE[1:]} if self.row else {}
        return {camera: rate for camera, rate in rates.items() if rate and rate.value < WEAK}


def judged_on(task: str) -> tuple[str, ...]:
    """The subsets of the mean; PokeCube's first person alone cannot see enough (paper)."""
    return tuple(c for c in THREE if task != "maniskill/poke-cube" or c != "first")


def judge(task: str, evidence: Sequence[Evidence]) -> Verdict:
    """The task's MAD policy on three cameras; of several, the one with the highest mean on other
    seeds than reporting ones, because nothing is chosen on these."""
    policies = [
        policy
        for policy in usual_alphas([one for one in evidence if not one.own_cameras])
        if (policy.config.task, policy.config.method, policy.config.setting, policy.config.merge)
        == (task, "mad", "three", "sum")
    ]
    if not policies:
        return Verdict(task, None, None, ())

    def rank(policy: Evidence) -> float:
        known = next(filter(None, map(policy.on, (DEVELOPMENT, READ, TRY))), None)
        mean = known and _row(known).mean(judged_on(task))
        return mean.value if mean else -1.0

    row = _row(max(policies, key=rank))
    mean = row.mean(judged_on(task))
    return Verdict(task, row, mean, tuple(_reasons(task, row, mean)))


def _row(evidence: Evidence) -> Row:
    """The policy's row; it names the policy also where no episode counts."""
    return replace(row_of(evidence.config.name, THREE, [evidence]), evidence=[evidence])


def _reasons(task: str, row: Row, mean: SuccessRate | None) -> list[str]:
    reasons = []
    missing = [c for c in judged_on(task) if c not in row.cells]
    if missing:
        reasons.append(f"{', '.join(missing)} not measured")
    whole = row.rate("all")
    if whole is not None and whole.value < LEAST_ALL:
        reasons.append(f"all {whole.value:.2f} is below {LEAST_ALL}")
    if mean is not None and mean.value < LEAST_MEAN:
        reasons.append(f"mean {mean.value:.2f} is below {LEAST_MEAN:.2f}")
    if mean is not None and mean.n < LEAST_EPISODES:
        reasons.append(f"{mean.n} episodes, {LEAST_EPISODES} are needed")
    return reasons


def verdict_json(verdict: Verdict) -> dict[str, Any]:
    """For ``--json``: the policy's folder, its rates with n and interval, the verdict."""
    row = verdict.row
    rates = {} if row is None else {column: row.rate(column) for column in THREE}
    return {
        "task": verdict.task,
        "policy": None if row is None else str(row.evidence[0].path),
        "verdict": verdict.words,
        **{name: rate.row() for name, rate in {**rates, "mean": verdict.mean}.items() if rate},
    }
