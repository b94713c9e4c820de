"""The report's pictures: every one is SVG text made from rows and curves."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from madviz.measure.evidence import Evidence
from madviz.measure.statistics import SuccessRate
from madviz.plots import figures
from madviz.report.layouts import LAYOUTS, THREE, rank
from madviz.report.rows import Row
from madviz.report.tables import SUITES, ResultTable
from madviz.report.threshold import WEAK, Verdict
from madviz.runs.curve import success_lines
from madviz.system.files import read_rows

DIFFERENCES: tuple[Callable[[Evidence], str], ...] = (
    lambda policy: policy.config.recipe,
    lambda policy: policy.config.merge,
    lambda policy: policy.config.setting,
    lambda policy: f"alpha {policy.config.training.alpha or 0:g}",
    lambda policy: policy.folder,
)
"""The facts in which curves of one method, seed and task may differ."""
TWENTY = "twenty.svg"
METHODS = "methods.svg"
CURVE = "reinforcement-"
"""Names of pictures; the last is the beginning of a task's."""


def bar(rate: SuccessRate | None) -> figures.Bar | None:
    """A rate as it is drawn."""
    return None if rate is None else figures.Bar(rate.value, *rate.interval)


def twenty(verdicts: Sequence[Verdict]) -> str:
    """Every task with all cameras and with each one alone."""
    rows = [verdict.row or Row(verdict.task) for verdict in verdicts]
    uses = sorted({row.seeds for row in rows if row.cells})
    tasks = [
        f"{verdict.task} ({row.seeds} seeds)" if row.cells and len(uses) > 1 else verdict.task
        for verdict, row in zip(verdicts, rows, strict=True)
    ]
    series = {subset: [bar(row.rate(subset)) for row in rows] for subset in THREE}
    title = f"MAD on twenty tasks: success, 95% intervals, {' and '.join(uses)} seeds"
    return figures.dots(title, tasks, series, (WEAK,))


def methods(tables: Sequence[ResultTable]) -> str:
    """Every method with every subset, on the tasks on which many were trained."""
    panels: dict[str, dict[str, list[float | None]]] = {}
    for table in tables:
        for task, row in table.rows:
            rates = [row.rate(column) for column in table.columns]
            cells = [None if rate is None else rate.value for rate in rates]
            panels.setdefault(task, {})[row.label] = cells
    labels = sorted({row.label for table in tables for row in table.averages}, key=rank)
    title = f"{tables[0].layout.title}, imitation, {_seeds(*tables)}"
    return figures.heat(title, labels, tables[0].columns, panels)


def rates(table: ResultTable) -> str:
    """The table's rows with their intervals, each over the tasks that all of them have; a mean only
    of rows that have all columns."""
    columns = table.columns
    groups = [*columns, *(["mean"] if table.layout.mean else [])]
    tasks = set.intersection(*(set(row.tasks) for row in table.averages))
    series = {}
    for whole in table.averages:
        row = whole.on(tasks) if tasks else whole
        measured = [row.rate(column) for column in columns]
        if table.layout.mean:
            measured.append(row.mean(columns) if all(measured) else None)
        series[row.label] = [bar(rate) for rate in measured]
    where = " and ".join(sorted(tasks)) or table.suite
    return figures.dots(f"{table.layout.title}: {where}, {_seeds(table)}", groups, series)


def _seeds(*tables: ResultTable) -> str:
    uses = sorted({row.seeds for table in tables for row in table.averages})
    return f"{' and '.join(uses)} seeds"


def curves(evidence: Sequence[Evidence]) -> dict[str, str]:
    """Success while training by reinforcement, by the picture's name: one for each task on which
    a training measured it by subset."""
    by_task: dict[str, list[Evidence]] = {}
    for policy in evidence:
        if policy.config.recipe != "light" and _curve(policy).is_file():
            by_task.setdefault(policy.config.task, []).append(policy)
    drawn = {task: _curves_on(task, by_task[task]) for task in sorted(by_task)}
    return {f"{CURVE}{task.replace('/', '-')}.svg": text for task, text in drawn.items() if text}


def is_ours(file: Path) -> bool:
    """Whether a report may have drawn it: of all tasks, of a table, or a task's curves."""
    keys = "|".join(layout.key for layout in LAYOUTS)
    of_table = rf"({keys})-({'|'.join(SUITES)})(-reinforcement)?\.svg"
    named = file.name in (TWENTY, METHODS) or re.fullmatch(of_table, file.name) is not None
    return file.is_file() and (named or (file.name.startswith(CURVE) and file.suffix == ".svg"))


def task_of(name: str) -> str:
    """The task of the picture ``name`` of ``curves``."""
    return name.removeprefix(CURVE).removesuffix(".svg").replace("-", "/", 1)


def _curves_on(task: str, evidence: Sequence[Evidence]) -> str:
    panels: dict[str, dict[str, figures.Line]] = {}
    for policy, label in zip(evidence, _told_apart(evidence), strict=True):
        lines = success_lines(read_rows(_curve(policy)))
        streams = policy.config.streams
        for subset, line in lines.items():
            name = streams[0] if len(streams) == 1 else subset
            panels.setdefault(name, {})[label] = line
    title = f"{task}: success at evaluations on selection seeds, 95% intervals"
    return figures.lines(title, "simulator steps", panels) if panels else ""


def _curve(evidence: Evidence) -> Path:
    return evidence.path / "curve.csv"


def _told_apart(evidence: Sequence[Evidence]) -> list[str]:
    """A name for each: its method and seed; and where several have the same, what else they
    differ in."""
    labels = [
        policy.config.method + (f", seed {policy.seed}" if policy.seed != 1 else "")
        for policy in evidence
    ]
    for fact in DIFFERENCES:
        named = list(zip(labels, evidence, strict=True))
        for place, (label, policy) in enumerate(named):
            alike = {
                fact(other)
                for name, other in named
                if name == label and other.config.streams == policy.config.streams
            }
            if len(alike) > 1:
                labels[place] = f"{label}, {fact(policy)}"
    return labels
