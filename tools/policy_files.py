"""The files that say what was measured of a policy, read for figures and tables."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from design_rows import design_tables

from madviz.measure.evidence import Evidence, find_evidence
from madviz.policies.seeds import DEVELOPMENT
from madviz.report.layouts import LAYOUTS, THREE
from madviz.report.rows import Row
from madviz.report.tables import ResultTable, build, row_of

ROOT = Path(__file__).resolve().parent.parent
SINGLES = THREE[1:]
LABELS = {"first": "First person", "third_a": "Third A", "third_b": "Third B"}


@cache
def policies() -> dict[str, Evidence]:
    """Every measured policy, with weights or without, by the name of its folder."""
    evidence, _ = find_evidence(ROOT / "checkpoints", ROOT / "results")
    return {policy.folder: policy for policy in evidence}


def row(folder: str, columns: Sequence[str] = THREE) -> Row:
    """Success of one policy, on the seeds of its evaluation.json."""
    return row_of(folder, columns, [policies()[folder]])


def on_development(folder: str, columns: Sequence[str] = THREE) -> Row:
    """Success of one policy on development seeds. Raises ValueError if it has none."""
    policy = policies()[folder].on(DEVELOPMENT)
    if policy is None:
        raise ValueError(f"expected episodes on development seeds of {folder}, found none")
    return row_of(folder, columns, [policy])


def rates(measured: Row, subsets: Sequence[str] = SINGLES) -> list[str]:
    """For each of ``subsets`` for example ``0.99 [0.95, 1.00]``, over all trainings; a dash where
    nothing was measured."""
    return [rate.without_count if (rate := measured.rate(subset)) else "–" for subset in subsets]


def every_table() -> list[ResultTable]:
    """The tables of results/RESULTS.md, and those that serve the claims only."""
    tables = [table for layout in LAYOUTS for table in build(layout, list(policies().values()))]
    return [*tables, *design_tables(ROOT / "results")]


def methods(task: str) -> dict[str, Row]:
    """By method, the row of ``results/RESULTS.md`` on one task, with all its trainings."""
    overall = [table for table in every_table() if table.layout.key == "overall"]
    return {row.label: row for table in overall for at, row in table.rows if at == task}
