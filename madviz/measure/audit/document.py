"""audit.json: the results of an audit in numbers.

Every row holds its difference from all cameras on the same scenes. ``p_holm`` is corrected for the
other tests of its family and for the looks (``verdict.py``): 0.05 is the limit everywhere. There
are three families, each wrong at most 5 times in 100: what verdicts rest on (every camera removed,
and alone against none); all other rows; and every camera occluded against the same one dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NotRequired, TypedDict

import numpy as np

from madviz.analysis.shapley import shares
from madviz.errors import UserError
from madviz.measure.audit.guarded import GuardedRows
from madviz.measure.audit.lost_cameras import INTACT, AuditRow, How, What
from madviz.measure.audit.schedule import AuditPlan, Outcomes, scale
from madviz.measure.audit.verdict import VERDICTS, Judgement, Look, table
from madviz.measure.formulas import agresti_min, holm, mcnemar, newcombe
from madviz.measure.statistics import SuccessRate
from madviz.observation.condition import Condition
from madviz.policies.config import definition_of
from madviz.policies.measured import RateRow
from madviz.types import Array, EnvSpec, PolicySpec

Seen = dict[Condition, Array]
"""Success (n,) bool in the episodes up to the last look."""


class DifferenceRow(TypedDict):
    """A paired difference of two success rates."""

    difference: float
    ci95: list[float]
    p_holm: float


class ConditionRow(DifferenceRow):
    """One condition; its difference is against all cameras."""

    camera: str | None
    what: What
    how: How
    success: float
    n: int
    ci_all: NotRequired[list[float]]
    """Where the verdict rests on the difference: its interval that holds for all cameras and looks
    together (``verdict.py``); *makes no difference* is said from it."""
    above_none: NotRequired[DifferenceRow]
    """This camera alone against no camera, where the verdict rests on it."""
    lost: NotRequired[list[int]]
    """The seeds that succeed with all cameras, and not here; ``won`` has the others that turned.
    Older documents have neither."""
    won: NotRequired[list[int]]


class OccludedRow(DifferenceRow):
    """A camera that is occluded against the same one dropped; occluded minus dropped."""

    camera: str
    how: How


class ShapleyRow(TypedDict):
    """A camera's part in success, on average over all orders in which cameras come."""

    value: float
    ci95: list[float]


class AuditFile(TypedDict):
    """The whole document."""

    schema: int
    policy: str
    task: str
    digest: str
    definition: str
    """The task's definition of a success."""
    seed: int
    """The first episode's."""
    episodes: int
    """Planned for each condition; ``n`` of a row is less where the audit stopped early."""
    looks: list[int]
    detectable: float | None
    """The change that would be found 8 times in 10; None where none would."""
    labels: dict[str, str]
    """The names of cameras for readers."""
    intact: RateRow
    """With all cameras."""
    conditions: list[ConditionRow]
    occluded: list[OccludedRow]
    shapley: dict[str, ShapleyRow]
    """Empty where there are too many cameras."""
    shapley_how: str
    outside: NotRequired[float]
    """The share of action numbers outside [-1, 1] in all episodes; they were clipped."""
    guarded: NotRequired[GuardedRows]
    """Broken cameras with the guard, where that was asked for."""
    decided_by: dict[str, dict[str, str]]
    """By camera, how it was removed and how the others were, for the verdict."""
    verdict: dict[str, str]


def audit_document(
    plan: AuditPlan, outcomes: Outcomes, policy: PolicySpec, env: EnvSpec, outside: float
) -> AuditFile:
    """The document of an audit of ``policy`` in ``env`` that is done; ``outside`` is as in the
    document. Raises UserError before the end."""
    end = plan.stopped(outcomes)
    if end is None or plan.wanted(outcomes):
        raise UserError("expected an audit that is done, found episodes missing; run it to the end")
    look, judgement = end
    n = look.episodes
    seen = {condition: plan.first(outcomes, condition, n) for condition in plan.every}
    cameras = plan.cameras
    deciding = {name: cameras.deciding(name) for name in cameras.names}
    smallest = plan.detectable
    dropped = not any(condition.occlusions for condition in cameras.sets())
    labels = {camera.name: camera.label for camera in env.cameras}
    return {
        "schema": 1,
        "policy": policy.name,
        "task": policy.task,
        "digest": policy.digest,
        "definition": definition_of(env),
        "seed": plan.seed,
        "episodes": plan.episodes,
        "looks": [each.episodes for each in plan.looks],
        "detectable": None if np.isnan(smallest) else round(smallest, 4),
        "labels": {name: labels.get(name, name) for name in cameras.names},
        "intact": SuccessRate.counted(seen[INTACT]).row(),
        "conditions": _rows(plan, seen, look, judgement),
        "occluded": _occluded(plan, seen, look),
        "shapley": _shapley(plan, seen),
        "shapley_how": "dropped" if dropped else "mean",
        "decided_by": {
            name: {"removed": rows.removed.how, "alone": rows.alone.how}
            for name, rows in deciding.items()
        },
        "verdict": {
            name: VERDICTS[int(code)]
            for name, code in zip(cameras.names, judgement.verdict, strict=True)
        },
        "outside": outside,
    }


def _rows(plan: AuditPlan, seen: Seen, look: Look, judgement: Judgement) -> list[ConditionRow]:
    cameras = plan.cameras
    deciding = [cameras.deciding(name) for name in cameras.names]
    rows = list(cameras.rows())
    removed = [each.removed for each in deciding]
    others = [row for row in rows if row not in removed]
    p = dict(zip(removed, judgement.p_removed, strict=True))
    against_intact = corrected([(seen[row.condition], seen[INTACT]) for row in others], look)
    p |= dict(zip(others, against_intact, strict=True))
    documents = {row: _row(row, seen, float(p[row])) for row in rows}
    for row, document in documents.items():
        change = seen[row.condition].astype(int) - seen[INTACT]  # (n,)
        document["lost"] = [plan.seed + int(place) for place in np.flatnonzero(change < 0)]
        document["won"] = [plan.seed + int(place) for place in np.flatnonzero(change > 0)]
    low, high = judgement.change
    for each, p_alone, *ends in zip(deciding, judgement.p_alone, low, high, strict=True):
        documents[each.removed]["ci_all"] = [float(end) for end in ends]
        alone = seen[each.alone.condition]
        floor = seen[each.floor.condition]
        documents[each.alone]["above_none"] = _difference(alone, floor, p_alone)
    return list(documents.values())


def _row(row: AuditRow, seen: Seen, p: float) -> ConditionRow:
    outcomes = seen[row.condition]
    return {
        "camera": row.camera,
        "what": row.what,
        "how": row.how,
        "success": float(outcomes.mean()),
        "n": len(outcomes),
        **_difference(outcomes, seen[INTACT], p),
    }


def _difference(first: Array, second: Array, p: float) -> DifferenceRow:
    """First (n,) bool minus second, on the same scenes."""
    return {
        "difference": float(first.mean() - second.mean()),
        "ci95": [float(end) for end in newcombe(*table(first, second))],
        "p_holm": float(p),
    }


def _occluded(plan: AuditPlan, seen: Seen, look: Look) -> list[OccludedRow]:
    """Every camera that can be dropped, in each other way."""
    removed = [row for row in plan.cameras.rows() if row.what == "removed"]
    dropped = {row.camera: seen[row.condition] for row in removed if row.how == "dropped"}
    others = [row for row in removed if row.how != "dropped" and row.camera in dropped]
    pairs = [(seen[row.condition], dropped[row.camera]) for row in others]
    return [
        {"camera": str(row.camera), "how": row.how, **_difference(first, second, p)}
        for row, (first, second), p in zip(others, pairs, corrected(pairs, look), strict=True)
    ]


def corrected(pairs: Sequence[tuple[Array, Array]], look: Look) -> Array:
    """p-values of a family of tests, each of two conditions on the same scenes (n,)."""
    if not pairs:
        return np.zeros(0)
    p = [mcnemar(*table(first, second)[1:3]) for first, second in pairs]
    return np.minimum(holm(p) * scale(look), 1.0)


def _shapley(plan: AuditPlan, seen: Seen) -> dict[str, ShapleyRow]:
    """The mean over scenes of what a camera adds in each scene, which lies in [-1, 1]."""
    sets = plan.cameras.sets()
    if not sets:
        return {}
    names = plan.cameras.names
    outcomes = np.stack([seen[condition] for condition in sets]).astype(float)  # (2^C, n)
    values = shares(len(names)) @ outcomes  # (C, n)
    low, high = agresti_min(values)
    return {
        name: {"value": float(values[i].mean()), "ci95": [float(low[i]), float(high[i])]}
        for i, name in enumerate(names)
    }
