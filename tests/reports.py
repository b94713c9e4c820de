"""What a report makes of a folder of policies."""

from __future__ import annotations

from pathlib import Path

from madviz.measure.evidence import find_evidence
from madviz.report.layouts import LAYOUTS
from madviz.report.results import ReportConfig, ReportResult, run_report
from madviz.report.rows import Row
from madviz.report.tables import ResultTable, build
from tests.evidence import rates

GOOD = rates(0.95, 0.90, 0.85, 0.80)


def table(root: Path, key: str, suite: str = "metaworld") -> ResultTable:
    layout = next(layout for layout in LAYOUTS if layout.key == key)
    return next(t for t in build(layout, find_evidence(root)[0]) if t.suite == suite)


def every_table(root: Path) -> list[ResultTable]:
    return [t for layout in LAYOUTS for t in build(layout, find_evidence(root)[0])]


def report(root: Path) -> tuple[ReportResult, str]:
    result = run_report(ReportConfig(root))
    return result, Path(result["path"]).read_text()


def average(table: ResultTable, label: str) -> Row:
    """The row of ``label`` over all its tasks."""
    return next(row for row in table.averages if row.label == label)
