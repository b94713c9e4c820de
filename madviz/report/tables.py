"""Tables filled with what was measured: which policies are compared, and their rows.

The paper's Single Camera baseline is three trainings, each with one camera; its row takes each
camera's cell from the policy that has this camera, and has no cell for all cameras.

Only equal budgets are compared: a task's rows are those of one budget of updates, give or take a
tenth, the one that most of them have. An average takes equally many trainings and episodes of every
task, the first ones that all of its rows have, so that a task with more of them does not pull it
towards itself. A difference of two rows takes the episodes that these two have.

Imitation and reinforcement learning never share a table, and neither do reporting seeds and
development seeds: where one policy has development seeds only, all others are taken on theirs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from madviz.envs.registry import METAWORLD_TASKS
from madviz.measure.evidence import Evidence, alike
from madviz.report.layouts import Layout, rank
from madviz.report.rows import Row

SUITES = {"metaworld", "maniskill"}
"""Whose tasks have tables; the toy and tasks of a user's own do not."""
ALIKE = 0.1
"""How much longer one may be trained than the other and still be compared, as a share."""


@dataclass(frozen=True)
class ResultTable:
    """A layout with the rows that were measured, by suite and task."""

    layout: Layout
    suite: str
    columns: tuple[str, ...]
    mean_of: tuple[str, ...]
    rows: tuple[tuple[str, Row], ...]
    """Task and row, tasks in order."""
    averages: tuple[Row, ...]
    """A row for every label over all its tasks, with equally many episodes of each."""
    imitation: bool = True
    """Whether its policies imitate an expert; otherwise they learn by reinforcement."""

    @property
    def name(self) -> str:
        """The name of its picture and in the CSV file: ``overall-metaworld``."""
        learning = "" if self.imitation or self.layout.key == "scratch" else "-reinforcement"
        return f"{self.layout.key}-{self.suite}{learning}"

    @property
    def evidence(self) -> list[Evidence]:
        """The policies in its rows."""
        return [each for _, row in self.rows for each in row.evidence]

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels of its averages, in their order."""
        return tuple(row.label for row in self.averages)

    def pair(self, first: str, second: str) -> tuple[Row, Row] | None:
        """Two rows over the tasks that both have, with equally many episodes of each: those that
        these two have, whatever a third one lacks. None where they share no task."""
        tasks = [{task for task, row in self.rows if row.label == one} for one in (first, second)]
        both = tasks[0] & tasks[1]
        rows = [(task, row) for task, row in self.rows if task in both]
        rows = [(task, row) for task, row in rows if row.label in (first, second)]
        return (_average(first, rows), _average(second, rows)) if both else None


def build(layout: Layout, evidence: Sequence[Evidence]) -> list[ResultTable]:
    """The tables of one layout, one for each suite with a task that has enough rows."""
    chosen = [(label, each) for each in evidence if (label := layout.label(each))]
    if layout.alphas != "all":
        usual = usual_alphas(evidence)
        others = [pair for pair in chosen if pair[1] not in usual]
        chosen = [pair for pair in chosen if pair[1] in usual]
        if layout.alphas == "named":
            chosen += [(f"{label}, alpha {each.alpha}", each) for label, each in others]
    tasks = {each.config.task for _, each in chosen}
    chosen = [pair for task in sorted(tasks) for pair in _comparable(layout, task, chosen)]
    kinds: dict[tuple[str, bool], list[tuple[str, Evidence]]] = {}
    for label, each in chosen:
        kinds.setdefault(
            (each.config.task.split("/")[0], each.config.recipe == "light"), []
        ).append((label, each))
    return [
        _table(layout, suite, imitation, _same_seeds(kinds[suite, imitation]))
        for suite, imitation in sorted(kinds)
        if suite in SUITES
    ]


def _same_seeds(chosen: Sequence[tuple[str, Evidence]]) -> list[tuple[str, Evidence]]:
    """All on reporting seeds, or all on development seeds."""
    labels = {each.path: label for label, each in chosen}
    return [(labels[each.path], each) for each in alike([each for _, each in chosen])]


def _table(
    layout: Layout, suite: str, imitation: bool, mine: Sequence[tuple[str, Evidence]]
) -> ResultTable:
    """The table of the policies of one suite, each with its row's label."""
    labels = sorted({label for label, _ in mine}, key=rank)
    columns, mean_of = _columns(layout, [each for _, each in mine])
    rows = []
    for task in sorted({each.config.task for _, each in mine}, key=_task_rank):
        for label in labels:
            members = [each for name, each in mine if (name, each.config.task) == (label, task)]
            row = row_of(label, columns, members)
            if row.cells:
                rows.append((task, row))
    averages = tuple(_average(label, rows) for label in labels)
    return ResultTable(layout, suite, columns, mean_of, tuple(rows), averages, imitation)


def _comparable(
    layout: Layout, task: str, chosen: Sequence[tuple[str, Evidence]]
) -> list[tuple[str, Evidence]]:
    """Rows of a task that can be compared: of one recipe and about one budget, and enough of
    them."""
    here = [(label, each) for label, each in chosen if each.config.task == task]
    found = []
    for recipe in sorted({each.config.recipe for _, each in here}):
        mine = [(label, each) for label, each in here if each.config.recipe == recipe]
        rows: dict[int, set[str]] = {}
        for label, each in mine:
            rows.setdefault(each.config.training.updates or 0, set()).add(label)
        near = {u: [few for few in rows if few <= u <= (1 + ALIKE) * few] for u in rows}
        labels = {u: set[str]().union(*(rows[few] for few in near[u])) for u in rows}
        budget = max(rows, key=lambda updates: (len(labels[updates]), updates))
        if len(labels[budget]) >= layout.needs:
            found += [p for p in mine if (p[1].config.training.updates or 0) in near[budget]]
    return found


def _columns(layout: Layout, mine: Sequence[Evidence]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if layout.key != "five":
        return layout.columns, layout.mean_of
    streams = max((each.config.streams for each in mine), key=len)
    return ("all", *streams), ("all", *streams)


def _average(label: str, rows: Sequence[tuple[str, Row]]) -> Row:
    """The row of ``label`` over its tasks, with episodes that all of ``rows`` have."""
    seeds = _shared_seeds(rows)
    whole = Row(label)
    for task, row in rows:
        if row.label == label:
            for column, cell in row.cells.items():
                kept = {unit: success for unit, success in cell.items() if unit[2] in seeds[task]}
                whole.cells.setdefault(column, {}).update(kept)
            whole.evidence += row.evidence
    return whole.equal_trainings()


def _shared_seeds(rows: Sequence[tuple[str, Row]]) -> dict[str, set[int]]:
    """By task, seeds that all of its rows have in every column: the first ones, equally many for
    each task."""
    shared: dict[str, set[int]] = {}
    for task, row in rows:
        for cell in row.cells.values():
            seeds = {unit[2] for unit in cell}
            shared[task] = shared.get(task, seeds) & seeds
    least = min((len(seeds) for seeds in shared.values() if seeds), default=0)
    return {task: set(sorted(seeds)[:least]) for task, seeds in shared.items()}


def row_of(label: str, columns: Sequence[str], members: Sequence[Evidence]) -> Row:
    """The row of ``members``, the policies of one task. A policy with one camera has no cell for
    all cameras where there are columns of single ones."""
    row = Row(label)
    for each in members:
        counts = False
        for column in columns:
            # All of one camera is not all cameras, where other rows have several.
            alone = len(each.config.streams) == 1 and column == "all" and "third_b" in columns
            outcomes = None if alone else each.of(column)
            for seed, success in (outcomes or {}).items():
                cell = row.cells.setdefault(column, {})
                unit = (each.config.task, each.seed, seed)
                counts |= unit not in cell
                cell.setdefault(unit, success)
        # A policy that adds no episode (Single Camera with this camera, of another setting) is not
        # trained again for this row.
        if counts:
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
        plain = [each.alpha for each in members if each.folder == each.config.name]
        counted = Counter(each.alpha for each in members)
        commonest = min(counted, key=lambda a: (-counted[a], a or 0.0))
        usual[key] = plain[0] if plain else commonest
    return [e for e in evidence if e.alpha == usual[_kind(e)]]


def _kind(evidence: Evidence) -> tuple[str, ...]:
    """All that policies have in common whose alphas are alternatives."""
    facts = ("task", "method", "setting", "recipe", "merge", "streams")
    return tuple(str(getattr(evidence.config, fact)) for fact in facts)


def _task_rank(task: str) -> tuple[int, str]:
    name = task.split("/")[-1]
    known = name in METAWORLD_TASKS
    return (METAWORLD_TASKS.index(name) if known else len(METAWORLD_TASKS), task)
