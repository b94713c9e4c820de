"""rates.csv: every rate of every table, one in a line."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from io import StringIO

from madviz.policies.checkpoint import WEIGHTS
from madviz.report.layouts import THREE
from madviz.report.rows import Row
from madviz.report.tables import ResultTable
from madviz.report.threshold import Verdict

COLUMNS = (
    "table",
    "task",
    "row",
    "subset",
    "success",
    "low",
    "high",
    "n",
    "trainings",
    "seeds",
    "policies",
    "weights",
)
"""``low`` and ``high``: the 95% interval, over episodes; over trainings too, where ``trainings`` is
above 1. ``policies``: their folders. ``weights``: whether they are all there."""


def rates_csv(verdicts: Sequence[Verdict], tables: Sequence[ResultTable]) -> str:
    """The file's text."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for verdict in verdicts:
        if verdict.row is not None:
            writer.writerows(_lines("twenty", verdict.task, verdict.row, THREE))
    for table in tables:
        for task, row in table.rows:
            writer.writerows(_lines(table.name, task, row, table.columns))
        for row in table.over_tasks:
            task = f"average of {len(row.tasks)}"
            writer.writerows(_lines(table.name, task, row, table.columns))
    return text.getvalue()


def _lines(table: str, task: str, row: Row, columns: Sequence[str]) -> Iterator[list[object]]:
    policies = " ".join(policy.folder for policy in row.evidence)
    whole = all((policy.path / WEIGHTS).is_file() for policy in row.evidence)
    for column in columns:
        if rate := row.rate(column):
            measured = [f"{value:.4f}" for value in (rate.value, *rate.interval)]
            facts = [row.trainings, row.seeds, policies, "yes" if whole else "no"]
            yield [table, task, row.label, column, *measured, rate.n, *facts]
