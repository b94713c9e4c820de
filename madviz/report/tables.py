"""The paper's tables, filled with what was measured here: which policy belongs where, its rates.

A *row* is a method on one or several tasks. Its cells hold single episodes and not rates, by
*unit*: task, training seed, episode seed. So any two rows can be paired unit by unit, trainings of
several seeds pool by themselves, and an average over tasks is the same code as one task:

    row          units of `all`                                   rate
    mad, hammer  (hammer, 1, 5000) yes, (hammer, 1, 5001) no ...  99 of 100
    mad, 2 tasks the same and (push, 1, 5000) yes ...             190 of 200

The paper's Single Camera baseline is three trainings, each with one camera; its row takes each
camera's cell from the policy that has this camera, and has no cell for all cameras.

What was trained for longer is no rival: a task's rows are those of one budget of updates, the one
that most of them have. An average takes of every task the episodes that all its rows have, so that
a policy that was evaluated for longer does not pull the average towards its task.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from madviz.envs.base import METAWORLD_TASKS
from madviz.report.evidence import Evidence
from madviz.statistics import Interval, difference_interval, mean_interval, wilson

Unit = tuple[str, int, int]
"""Task, training seed, episode seed."""

THREE = ("all", "first", "third_a", "third_b")
MERGES = ("sum", "concat", "frame-stack", "attention", "vit", "q-mean")
OWN_MERGE = {"mvd": "mvd", "vib": "vib"}
"""How a method merges where it is not by a sum."""
ORDER = ("mad", "single", "mvd", "vib", "mv-mwm", "naive-both", "merged-only", "singular-only")
SUITES = {"metaworld", "maniskill"}
"""Whose tasks have tables; the toy and tasks of a user's own do not."""


@dataclass(frozen=True)
class Rate:
    """A success rate as it is printed."""

    value: float
    interval: Interval
    n: int
    """Episodes of one subset; a mean over several has as many of each."""


@dataclass
class Row:
    """See the module."""

    label: str
    cells: dict[str, dict[Unit, bool]] = field(default_factory=dict)
    evidence: list[Evidence] = field(default_factory=list)

    @property
    def tasks(self) -> tuple[str, ...]:
        return tuple(sorted({unit[0] for cell in self.cells.values() for unit in cell}))

    @property
    def trainings(self) -> int:
        """Training seeds, at most, on any of the tasks."""
        seeds = {unit[:2] for cell in self.cells.values() for unit in cell}
        return max(Counter(task for task, _ in seeds).values(), default=0)

    def rate(self, column: str) -> Rate | None:
        """None where nothing was measured."""
        cell = self.cells.get(column)
        if not cell:
            return None
        successes = sum(cell.values())
        return Rate(successes / len(cell), wilson(successes, len(cell)), len(cell))

    def shares(self, columns: Sequence[str]) -> dict[Unit, float]:
        """By unit, the share of ``columns`` that succeeded; of units that have them all."""
        cells = [self.cells.get(column, {}) for column in columns]
        common = set.intersection(*map(set, cells)) if cells else set()
        return {unit: sum(cell[unit] for cell in cells) / len(cells) for unit in sorted(common)}

    def measured(self, columns: Sequence[str]) -> list[str]:
        return [column for column in columns if self.cells.get(column)]

    def mean(self, columns: Sequence[str]) -> Rate | None:
        """Over those of ``columns`` that this row has."""
        present = self.measured(columns)
        shares = list(self.shares(present).values())
        if not shares:
            return None
        interval = mean_interval(shares, len(present))
        return Rate(sum(shares) / len(shares), interval, len(shares))


@dataclass(frozen=True)
class Difference:
    """First minus second, on the units and columns that both have."""

    value: float
    interval: Interval
    n: int
    tasks: tuple[str, ...]
    columns: tuple[str, ...]


def difference(first: Row, second: Row, columns: Sequence[str]) -> Difference | None:
    """Of the means over the columns both rows have; None where no episodes can be paired."""
    shared = [c for c in first.measured(columns) if c in second.measured(columns)]
    mine, theirs = first.shares(shared), second.shares(shared)
    units = [unit for unit in mine if unit in theirs]
    if not shared or not units:
        return None
    gaps = [mine[unit] - theirs[unit] for unit in units]
    tasks = tuple(sorted({unit[0] for unit in units}))
    value = sum(gaps) / len(gaps)
    return Difference(value, difference_interval(gaps), len(gaps), tasks, tuple(shared))


@dataclass(frozen=True)
class Layout:
    """One of the paper's tables: who is in it, under which name, and what is looked at."""

    key: str
    title: str
    label: Callable[[Evidence], str | None]
    """The row a policy belongs to; None keeps it out."""
    columns: tuple[str, ...]
    mean_of: tuple[str, ...] = ()
    """Columns of the last one, the mean; none: no such column."""
    needs: int = 1
    """Rows without which a task would compare nothing, and stays out."""
    all_alphas: bool = False
    """Whether policies count that differ from a method's usual alpha."""


def _method(evidence: Evidence) -> str:
    """The method, and what of it is not as usual."""
    name = evidence.method
    if evidence.merge != OWN_MERGE.get(name, "sum"):
        name = f"{name} with {evidence.merge}"
    return name if evidence.recipe == "light" else f"{name}, {evidence.recipe}"


def _in(setting: str, methods: Iterable[str] = ()) -> Callable[[Evidence], str | None]:
    chosen = tuple(methods)

    def label(evidence: Evidence) -> str | None:
        fits = evidence.setting == setting and (not chosen or evidence.method in chosen)
        # What compares merges has a table of its own.
        other = evidence.method == "merged-only" and evidence.merge != "sum"
        return _method(evidence) if fits and evidence.method not in MERGES and not other else None

    return label


def _overall(evidence: Evidence) -> str | None:
    """All methods with three cameras, and Single Camera, whose setting may be any with one."""
    if evidence.method == "single" and evidence.setting in ("three", "one-rgb"):
        return _method(evidence)
    return _in("three")(evidence)


def _alpha(evidence: Evidence) -> str | None:
    if _in("three", ("mad",))(evidence) is None or evidence.alpha is None:
        return None
    recipe = "" if evidence.recipe == "light" else f", {evidence.recipe}"
    return f"alpha {evidence.alpha:g}{recipe}"


def _merge(evidence: Evidence) -> str | None:
    if evidence.setting != "three":
        return None
    name = evidence.method if evidence.method in MERGES else None
    if evidence.method == "merged-only":
        name = evidence.merge
    return name if name is None or evidence.recipe == "light" else f"{name}, {evidence.recipe}"


def any_method(evidence: Evidence) -> str | None:
    """Everybody's row with three cameras, however views are merged."""
    return _overall(evidence) or _merge(evidence)


def _modality(evidence: Evidence) -> str | None:
    inside = evidence.setting == "three-rgbd" or evidence.setting.startswith("one-")
    return f"{_method(evidence)}, {evidence.setting}" if inside else None


def _scratch(evidence: Evidence) -> str | None:
    return None if evidence.recipe == "light" else _overall(evidence)


LAYOUTS = (
    Layout("overall", "Overall robustness", _overall, THREE, THREE, needs=2),
    Layout("scratch", "Reinforcement learning from scratch", _scratch, THREE, THREE),
    Layout(
        "components",
        "Component ablation",
        _in("three", ("mad", "naive-both", "merged-only", "singular-only")),
        THREE,
        THREE,
        needs=2,
    ),
    Layout("alpha", "Alpha ablation", _alpha, THREE, THREE, needs=2, all_alphas=True),
    Layout("methods", "Every method", any_method, THREE, THREE, needs=9),
    Layout("merging", "Multi-view merging", _merge, ("all",), needs=2),
    Layout("occlusion", "Two cameras turned away", _in("turned-away"), ("all", "third_a")),
    Layout("modality", "Modalities", _modality, ("all", "rgb", "depth")),
    Layout("five", "Five views", _in("five"), ("all",), ("all",)),
    Layout("resolution", "Mixed resolutions", _in("mixed-resolution"), THREE, THREE),
)
"""In the paper's order, and beside its merging all methods of a task where most were trained. Five
views: the columns are those of the policies, see ``build``."""


@dataclass(frozen=True)
class Table:
    """A layout with the rows that were measured, by suite and task."""

    layout: Layout
    suite: str
    columns: tuple[str, ...]
    mean_of: tuple[str, ...]
    rows: tuple[tuple[str, Row], ...]
    """Task and row, tasks in order."""
    averages: tuple[Row, ...]
    """A row for every label over all its tasks, of the episodes that a task's rows share."""

    def average(self, label: str) -> Row | None:
        return next((row for row in self.averages if row.label == label), None)


def build(layout: Layout, evidence: Sequence[Evidence]) -> list[Table]:
    """The tables of one layout, one for each suite with a task that has enough rows."""
    pool = list(evidence) if layout.all_alphas else usual_alphas(evidence)
    chosen = [(label, each) for each in pool if (label := layout.label(each))]
    tasks = {each.task for _, each in chosen}
    chosen = [pair for task in sorted(tasks) for pair in _rivals(layout, task, chosen)]
    tables = []
    for suite in sorted({each.task.split("/")[0] for _, each in chosen} & SUITES):
        mine = [(label, each) for label, each in chosen if each.task.startswith(f"{suite}/")]
        labels = sorted({label for label, _ in mine}, key=_rank)
        columns, mean_of = _columns(layout, [each for _, each in mine])
        rows = [
            (
                task,
                _row(label, columns, [e for name, e in mine if name == label and e.task == task]),
            )
            for task in sorted({each.task for _, each in mine}, key=_task_rank)
            for label in labels
        ]
        rows = [(task, row) for task, row in rows if row.cells]
        shared = _shared_seeds(rows)
        averages = [
            _row(label, columns, [e for name, e in mine if name == label], shared)
            for label in labels
        ]
        tables.append(Table(layout, suite, columns, mean_of, tuple(rows), tuple(averages)))
    return tables


def _rivals(
    layout: Layout, task: str, chosen: Sequence[tuple[str, Evidence]]
) -> list[tuple[str, Evidence]]:
    """Rows of a task that can be compared: of one recipe and budget, and enough of them."""
    here = [(label, each) for label, each in chosen if each.task == task]
    kept = []
    for recipe in sorted({each.recipe for _, each in here}):
        mine = [(label, each) for label, each in here if each.recipe == recipe]
        rows: dict[int, set[str]] = {}
        for label, each in mine:
            rows.setdefault(each.updates or 0, set()).add(label)
        budget = max(rows, key=lambda updates: (len(rows[updates]), updates))
        if len(rows[budget]) >= layout.needs:
            kept += [pair for pair in mine if (pair[1].updates or 0) == budget]
    return kept


def _columns(layout: Layout, mine: list[Evidence]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if layout.key != "five":
        return layout.columns, layout.mean_of
    streams = max((each.streams for each in mine), key=len)
    return ("all", *streams), ("all", *streams)


def _shared_seeds(rows: Sequence[tuple[str, Row]]) -> dict[str, set[int]]:
    """By task, the seeds of the episodes that all of its rows and their columns have."""
    shared: dict[str, set[int]] = {}
    for task, row in rows:
        for cell in row.cells.values():
            seeds = {unit[2] for unit in cell}
            shared[task] = shared.get(task, seeds) & seeds
    return shared


def _row(
    label: str,
    columns: Sequence[str],
    members: Sequence[Evidence],
    seeds: Mapping[str, set[int]] | None = None,
) -> Row:
    """``seeds``: by task, the only episodes that count; None: all of them."""
    row = Row(label)
    for each in members:
        for column in columns:
            # All of one camera is not all cameras, where other rows have several.
            alone = len(each.streams) == 1 and column == "all" and "third_b" in columns
            found = None if alone else each.of(column)
            for seed, success in (found or {}).items():
                if seeds is not None and seed not in seeds.get(each.task, ()):
                    continue
                cell = row.cells.setdefault(column, {})
                cell.setdefault((each.task, each.seed, seed), success)
        row.evidence.append(each)
    return row


def usual_alphas(evidence: Sequence[Evidence]) -> list[Evidence]:
    """Without the policies of an alpha ablation: of every task, method, setting and recipe those
    whose alpha is that of the policy whose folder has the plain name; without one, the commonest.
    """
    groups: dict[tuple[str, ...], list[Evidence]] = {}
    for each in evidence:
        groups.setdefault(_kind(each), []).append(each)
    usual = {}
    for key, members in groups.items():
        plain = [each.alpha for each in members if each.folder == each.name]
        counted = Counter(each.alpha for each in members)
        commonest = min(counted, key=lambda a: (-counted[a], a or 0.0))
        usual[key] = plain[0] if plain else commonest
    return [e for e in evidence if e.alpha == usual[_kind(e)]]


def _kind(evidence: Evidence) -> tuple[str, ...]:
    """All that policies have in common whose alphas are alternatives."""
    facts = ("task", "method", "setting", "recipe", "merge", "streams")
    return tuple(str(getattr(evidence, fact)) for fact in facts)


def _rank(label: str) -> tuple[int, str]:
    name = label.split(",")[0]
    order = (*ORDER, *MERGES)
    return (order.index(name) if name in order else len(order), label)


def _task_rank(task: str) -> tuple[int, str]:
    name = task.split("/")[-1]
    known = name in METAWORLD_TASKS
    return (METAWORLD_TASKS.index(name) if known else len(METAWORLD_TASKS), task)
