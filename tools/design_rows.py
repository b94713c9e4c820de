"""Tables from trainings of which only the outcomes are kept: a CSV file for each design.

A line is one subset of one training, with a digit for each evaluated episode, 1 for a success:

    task, episodes, seed, method, alpha, camera, subset, first_seed, at_last_step, at_any_step

*episodes* is the recorded set that was learned from, and *seed* that of the training. ``camera`` is
that of Single Camera, whose *all* is this camera; the other methods have all cameras and each one
alone. Nothing is said of a task before all trainings that its design asks for are there.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from madviz.errors import UserError
from madviz.report.layouts import THREE, Layout
from madviz.report.rows import Row
from madviz.report.tables import ResultTable

Line = Mapping[str, str]
Outcome = Literal["at_last_step", "at_any_step"]
TRAINING = ("task", "episodes", "seed", "method", "alpha", "camera")
"""One training differs from another in one of these."""
COLUMNS = [*TRAINING, "subset", "first_seed", "at_last_step", "at_any_step"]


@dataclass(frozen=True)
class Design:
    """A file of outcomes: its table, and when a task of it is complete."""

    layout: Layout
    imitation: bool
    trainings: Mapping[str, int]
    """How many make a task complete."""
    label: Callable[[Line], str]
    """The row that a line belongs to."""


def _loss(line: Line) -> str:
    """``mad, alpha 0.25, turns``; of the other losses, ``single, turns``."""
    alpha = f", alpha {line['alpha']}" if line["method"] == "mad" else ""
    return f"{line['method']}{alpha}, {line['episodes']}"


def _layout(key: str) -> Layout:
    return Layout(key, "", "", lambda _: None, THREE)


DESIGNS = {
    "rewards.csv": Design(
        _layout("rewards"), False, {"toy/reach": 25}, lambda line: line["method"]
    ),
    "crossed.csv": Design(
        _layout("crossed"), True, {"metaworld/push": 33, "maniskill/push-cube": 18}, _loss
    ),
}
"""By the name of a file; results/designs.md says what each is for."""


def design_tables(folder: Path) -> list[ResultTable]:
    """The tables of the complete tasks of every design that has a file in ``folder``, by success at
    the last step. Raises UserError for a file with other columns or outcomes."""
    tables = []
    for name, design in DESIGNS.items():
        file = folder / name
        if not file.is_file():
            continue
        found = finished(file)
        complete = [task for task, wanted in design.trainings.items() if found[task] >= wanted]
        rows = read_rows(file, "at_last_step")
        for suite in sorted({task.split("/")[0] for task in complete}):
            mine = tuple((t, row) for t, row in rows if t in complete and t.startswith(f"{suite}/"))
            imitation = design.imitation
            tables.append(ResultTable(design.layout, suite, THREE, mine, (), imitation))
    return tables


def finished(file: Path) -> Counter[str]:
    """By task, how many trainings have all their outcomes in ``file``. Raises UserError."""
    subsets: dict[tuple[str, ...], set[str]] = {}
    for line in _lines(file):
        training = tuple(line[word] for word in TRAINING)
        subsets.setdefault(training, set()).add(line["subset"])
    wanted = ({*THREE}, {"all"})  # Without a camera of its own, and with one.
    return Counter(
        training[0] for training, found in subsets.items() if found == wanted[bool(training[-1])]
    )


def read_rows(file: Path, outcome: Outcome) -> list[tuple[str, Row]]:
    """Task and row of every method in ``file``. Raises UserError."""
    label = DESIGNS[file.name].label
    found: dict[tuple[str, str], Row] = {}
    for line in _lines(file):
        key = (line["task"], label(line))
        row = found.setdefault(key, Row(key[1]))
        cell = row.cells.setdefault(line["camera"] or line["subset"], {})
        for number, digit in enumerate(line[outcome]):
            unit = (line["task"], int(line["seed"]), int(line["first_seed"]) + number)
            cell[unit] = digit == "1"
    return [(task, row) for (task, _), row in found.items()]


def _lines(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as text:
        reader = csv.DictReader(text)
        lines = list(reader)
    if reader.fieldnames != COLUMNS:
        raise UserError(
            f"{file}: expected the columns {', '.join(COLUMNS)}, found {reader.fieldnames}"
        )
    for number, line in enumerate(lines, 2):
        if None in line or None in line.values() or not _readable(line):
            raise UserError(
                f"{file}: expected seeds, and 0 or 1 for each episode, found something else in "
                f"line {number}"
            )
    return lines


def _readable(line: Line) -> bool:
    last = line["at_last_step"]
    ever = line["at_any_step"]
    seeds = line["seed"].isdecimal() and line["first_seed"].isdecimal()
    return seeds and len(last) == len(ever) > 0 and {*last, *ever} <= {*"01"}
