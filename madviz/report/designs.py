"""Tables from trainings of which only the outcomes are kept: a CSV file for each design.

A line is one subset of one training, with a digit for each of its episodes, 1 for a success:

    task, episodes, seed, method, alpha, camera, subset, first_seed, at_last_step, at_any_step

*episodes* is what was learned from, and *seed* that of the training. ``camera`` is that
of Single Camera, whose *all* is this camera.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Literal

from madviz.errors import UserError
from madviz.report.layouts import THREE, Layout
from madviz.report.rows import Row
from madviz.report.tables import ResultTable

Outcome = Literal["at_last_step", "at_any_step"]
FILES = {
    "rewards.csv": Layout(
        "rewards", "From rewards", "Do methods differ, trained from rewards?", lambda _: None, THREE
    )
}
"""By the name of a design's file, its table."""


def design_tables(folder: Path) -> list[ResultTable]:
    """The tables of the designs that have a file in ``folder``, by success at the last step.
    Raises UserError for a file with other columns or outcomes."""
    tables = []
    for name, layout in FILES.items():
        if (folder / name).is_file():
            rows = read_rows(folder / name, "at_last_step")
            suites = {task.split("/")[0] for task, _ in rows}
            for suite in sorted(suites):
                mine = tuple(pair for pair in rows if pair[0].startswith(f"{suite}/"))
                tables.append(ResultTable(layout, suite, THREE, mine, (), imitation=False))
    return tables


def read_rows(file: Path, outcome: Outcome) -> list[tuple[str, Row]]:
    """Task and row of every method in ``file``. Raises UserError."""
    found: dict[tuple[str, str], Row] = {}
    try:
        with file.open(newline="") as lines:
            for line in csv.DictReader(lines):
                task = line["task"]
                row = found.setdefault((task, line["method"]), Row(line["method"]))
                cell = row.cells.setdefault(line["camera"] or line["subset"], {})
                for number, digit in enumerate(line[outcome]):
                    unit = (task, int(line["seed"]), int(line["first_seed"]) + number)
                    cell[unit] = bool(int(digit))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{file}: expected a design's columns, and 0 or 1 for each episode, found {error!r:.80}"
        ) from error
    return [(task, row) for (task, _), row in found.items()]
