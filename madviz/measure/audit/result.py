"""audit.json: what the episodes of an audit say, in numbers.

Every row holds its difference from all cameras on the same scenes. ``p_holm`` is corrected for the
other tests of its family and for the looks (``rule.py``): 0.05 is the limit everywhere. There are
three families, each wrong at most 5 times in 100: what verdicts rest on (every camera removed, and
alone against none); all other rows; and every camera occluded against the same one dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NotRequired, TypedDict

import numpy as np

from madviz.analysis.shapley import shares
from madviz.errors import UserError
from madviz.measure.audit.conditions import INTACT, AuditCondition, How, Played, What
from madviz.measure.audit.plan import AuditPlan, Outcomes, scale
from madviz.measure.audit.rule import VERDICTS, Judgement, Look, table
from madviz.measure.formulas import agresti_min, holm, mcnemar, newcombe
from madviz.measure.statistics import wilson
from madviz.types import Array


class IntactRow(TypedDict):
    """The success rate with all cameras."""

    success: float
    n: int
    ci95: list[float]


class DifferenceRow(TypedDict):
    """A paired difference of two success rates."""

    difference: float
    ci95: list[float]
    p_holm: float


class ConditionRow(TypedDict):
    """One condition; ``difference``, ``ci95`` and ``p_holm`` are against all cameras."""

    camera: str | None
    what: What
    how: How
    success: float
    n: int
    difference: float
    ci95: list[float]
    p_holm: float
    above_none: NotRequired[DifferenceRow]
    """This camera alone against no camera, where the verdict rests on it."""


class OccludedRow(TypedDict):
    """A camera that is occluded against the same one dropped; occluded minus dropped."""

    camera: str
    how: How
    difference: float
    ci95: list[float]
    p_holm: float


class ShapleyRow(TypedDict):
    """What a camera adds to success, on average over all orders in which cameras come."""

    value: float
    ci95: list[float]


class AuditFile(TypedDict):
    """The whole document."""

    schema: int
    policy: str
    task: str
    digest: str
    definition: str
    """What counts as a success."""
    seed: int
    """The first episode's."""
    episodes: int
    """Planned for each condition; ``n`` of a row is less where the audit stopped early."""
    looks: list[int]
    detectable: float | None
    """The change that would be found 8 times in 10; None where none would."""
    labels: dict[str, str]
    """What cameras are called."""
    intact: IntactRow
    conditions: list[ConditionRow]
    occluded: list[OccludedRow]
    shapley: dict[str, ShapleyRow]
    """Empty where there are too many cameras."""
    shapley_how: str
    decided_by: dict[str, dict[str, str]]
    """By camera, how it was removed and how the others were, for the verdict."""
    verdict: dict[str, str]


def result(plan: AuditPlan, outcomes: Outcomes, facts: dict[str, Any]) -> AuditFile:
    """The document of an audit that is done; ``facts`` has policy, task, digest, definition and
    labels. Raises UserError before the end."""
    end = plan.stopped(outcomes)
    if end is None or plan.wanted(outcomes):
        raise UserError("expected an audit that is done, found episodes missing; run it to the end")
    look, judgement = end
    n = look.episodes
    seen = {played: plan.outcomes_of(outcomes, played, n) for played in plan.every}
    names, cameras = plan.cameras.names, plan.cameras
    intact = seen[INTACT]
    smallest = plan.detectable
    return {
        "schema": 1,
        "policy": facts["policy"],
        "task": facts["task"],
        "digest": facts["digest"],
        "definition": facts["definition"],
        "seed": plan.seed,
        "episodes": plan.episodes,
        "looks": [each.episodes for each in plan.looks],
        "detectable": None if np.isnan(smallest) else round(smallest, 4),
        "labels": {name: facts["labels"].get(name, name) for name in names},
        "intact": {
            "success": float(intact.mean()),
            "n": n,
            "ci95": list(wilson(int(intact.sum()), n)),
        },
        "conditions": _rows(plan, seen, look, judgement),
        "occluded": _occluded(plan, seen, look),
        "shapley": _shapley(plan, seen),
        "shapley_how": "dropped" if not any(p.occlusions for p in cameras.sets()) else "mean",
        "decided_by": {
            name: {what: cameras.deciding(what, name).how for what in ("removed", "alone")}
            for name in names
        },
        "verdict": {
            name: VERDICTS[int(code)] for name, code in zip(names, judgement.verdict, strict=True)
        },
    }


def _rows(
    plan: AuditPlan, seen: dict[Played, Array], look: Look, judgement: Judgement
) -> list[ConditionRow]:
    cameras, names = plan.cameras, plan.cameras.names
    conditions = list(cameras.every())
    removed = [cameras.deciding("removed", name) for name in names]
    others = [one for one in conditions if one not in removed]
    p = dict(zip(removed, judgement.p_removed, strict=True))
    against_intact = corrected([(seen[one.played], seen[INTACT]) for one in others], look)
    p |= dict(zip(others, against_intact, strict=True))
    rows = [_row(one, seen, float(p[one])) for one in conditions]
    for name, p_alone in zip(names, judgement.p_alone, strict=True):
        deciding = cameras.deciding("alone", name)
        first, second = seen[deciding.played], seen[cameras.floor(name).played]
        rows[conditions.index(deciding)]["above_none"] = {
            "difference": float(first.mean() - second.mean()),
            "ci95": _interval(first, second),
            "p_holm": float(p_alone),
        }
    return rows


def _row(one: AuditCondition, seen: dict[Played, Array], p: float) -> ConditionRow:
    mine, intact = seen[one.played], seen[INTACT]
    return {
        "camera": one.camera,
        "what": one.what,
        "how": one.how,
        "success": float(mine.mean()),
        "n": len(mine),
        "difference": float(mine.mean() - intact.mean()),
        "ci95": _interval(mine, intact),
        "p_holm": p,
    }


def _occluded(plan: AuditPlan, seen: dict[Played, Array], look: Look) -> list[OccludedRow]:
    """Every camera that can be dropped, in each other way."""
    dropped = {
        one.camera: one
        for one in plan.cameras.every()
        if (one.what, one.how) == ("removed", "dropped")
    }
    others = [
        one
        for one in plan.cameras.every()
        if one.what == "removed" and one.how != "dropped" and one.camera in dropped
    ]
    pairs = [(seen[one.played], seen[dropped[one.camera].played]) for one in others]
    return [
        {
            "camera": str(one.camera),
            "how": one.how,
            "difference": float(first.mean() - second.mean()),
            "ci95": _interval(first, second),
            "p_holm": float(p),
        }
        for one, (first, second), p in zip(others, pairs, corrected(pairs, look), strict=True)
    ]


def corrected(pairs: Sequence[tuple[Array, Array]], look: Look) -> Array:
    """p-values of a family of tests, each of two conditions on the same scenes (n,)."""
    if not pairs:
        return np.zeros(0)
    p = [mcnemar(*table(first, second)[1:3]) for first, second in pairs]
    return np.minimum(holm(p) * scale(look), 1.0)


def _shapley(plan: AuditPlan, seen: dict[Played, Array]) -> dict[str, ShapleyRow]:
    """Of every scene, then their mean: what a camera adds in a scene lies in [-1, 1]."""
    sets = plan.cameras.sets()
    if not sets:
        return {}
    names = plan.cameras.names
    each = shares(len(names)) @ np.stack([seen[played] for played in sets]).astype(float)
    low, high = agresti_min(each)
    return {
        name: {"value": float(each[i].mean()), "ci95": [float(low[i]), float(high[i])]}
        for i, name in enumerate(names)
    }


def _interval(first: Array, second: Array) -> list[float]:
    return [float(end) for end in newcombe(*table(first, second))]
