"""The files that say what was measured of a policy, read for figures and tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SINGLES = ("first", "third_a", "third_b")
LABELS = {"first": "First person", "third_a": "Third A", "third_b": "Third B"}
Evaluation = dict[str, Any]
"""An evaluation.json."""


def measured(*policies: str) -> list[Evaluation]:
    """What was measured of each, all on reporting seeds or all on development seeds."""
    found = [evaluation(policy) for policy in policies]
    if len({seeds(one) for one in found}) == 1:
        return found
    return [evaluation(policy, development=True) for policy in policies]


def evaluation(policy: str, development: bool = False) -> Evaluation:
    """evaluation.json of a policy with weights or of a row of a table; or its figures on
    development seeds."""
    for folder in ("checkpoints", "results/tables"):
        file = ROOT / folder / policy / "evaluation.json"
        earlier = file.with_name("development.json")
        if file.is_file():
            return json.loads((earlier if development and earlier.is_file() else file).read_text())
    raise FileNotFoundError(f"expected {policy}/evaluation.json in checkpoints/ or results/tables/")


def seeds(found: Evaluation) -> str:
    """The rule of ``madviz.policies.seeds``, in short."""
    return "reporting seeds" if found["seed"] >= 10_000 else "development seeds"
