"""The files that say what was measured of a policy, read for figures and tables."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

from madviz.measure.evidence import find_evidence
from madviz.report.layouts import LAYOUTS
from madviz.report.rows import Row
from madviz.report.tables import build

ROOT = Path(__file__).resolve().parent.parent
SINGLES = ("first", "third_a", "third_b")
LABELS = {"first": "First person", "third_a": "Third A", "third_b": "Third B"}
Evaluation = dict[str, Any]
"""An evaluation.json."""


def evaluation(policy: str, development: bool = False) -> Evaluation:
    """evaluation.json of a policy with weights or of a row of a table; or its figures on
    development seeds."""
    file = _file(policy, "evaluation.json")
    earlier = file.with_name("development.json")
    return json.loads((earlier if development and earlier.is_file() else file).read_text())


def config_of(policy: str) -> dict[str, Any]:
    """config.json of a policy with weights or of a row of a table."""
    return json.loads(_file(policy, "config.json").read_text())


def _file(policy: str, name: str) -> Path:
    for folder in ("checkpoints", "results/tables"):
        if (file := ROOT / folder / policy / name).is_file():
            return file
    raise FileNotFoundError(f"expected {policy}/{name} in checkpoints/ or results/tables/")


def rate(found: Evaluation, subset: str = "all") -> str:
    """For example ``0.99 [0.95, 1.00]``."""
    row = found["subsets"][subset]
    low, high = row["ci95"]
    return f"{row['success']:.2f} [{low:.2f}, {high:.2f}]"


@cache
def methods(task: str) -> dict[str, Row]:
    """By method, the row of ``results/RESULTS.md`` on one task, with all its trainings."""
    overall = next(layout for layout in LAYOUTS if layout.key == "overall")
    evidence, _ = find_evidence(ROOT / "checkpoints", ROOT / "results")
    tables = [one for one in build(overall, evidence) if one.imitation]
    return {row.label: row for one in tables for at, row in one.rows if at == task}


def seeds(found: Evaluation) -> str:
    """The rule of ``madviz.policies.seeds``, in short."""
    return "reporting seeds" if found["seed"] >= 10_000 else "development seeds"
