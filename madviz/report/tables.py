"""Tables filled with what was measured: which policies are compared, and their rows.

The paper's Single Camera baseline is three trainings, each with one camera; its row takes each
camera's cell from the policy that has this camera, and has no cell for all cameras.

Only equal budgets are compared: a task's rows are those of one budget of updates, give or take a
tenth, the one that most of them have. An average takes equally many trainings and episodes of every
task, the first ones that all of its rows have, so that a task with more of them does not pull it
towards itself. A difference of two rows takes the episodes that these two have.

Imitation and reinforcement learning never share a table, and neither do seeds of different uses:
where one policy has development seeds only, all others are taken on theirs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from madviz.envs.registry import METAWORLD_TASKS
from madviz.measure.evidence import Evidence, alike
from madviz.report.layouts import Layout, rank
from madviz.report.rows import Difference, Row, difference
from madviz.system.streams import say

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
    def over_tasks(self) -> list[Row]:
        """The averages over more than one task."""
        return [row for row in self.averages if len(row.tasks) > 1]

    @property
    def evidence(self) -> list[Evidence]:
        """The policies in its rows."""
        return [policy for _, row in self.rows for policy in row.evidence]

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels of its averages, in their order."""
        return tuple(row.label for row in self.averages)

    def pair(self, first: str, second: str) -> tuple[Row, Row] | None:
        """Two rows over the tasks that both have, with equally many episodes of each: those that
        these two have, whatever a third one lacks. None where they share no task."""
        rows = [(task, row) for task, row in self.rows if row.label in (first, second)]
        counted = Counter(task for task, _ in rows)
        both = [task for task in counted if counted[task] == 2]
        rows = [(task, row) for task, row in rows if task in both]
        return (_average(first, rows), _average(second, rows)) if both else None

    def difference(self, first: str, second: str, columns: Sequence[str]) -> Difference | None:
        """That of two rows; None where no episodes can be paired."""
        rows = self.pair(first, second)
        return difference(*rows, columns) if rows else None


def build(layout: Layout, evidence: Sequence[Evidence]) -> list[ResultTable]:
    """The tables of one layout, one for each suite with a task that has enough rows."""
    suite = [policy for policy in evidence if not policy.own_cameras]
    chosen = [(label, policy) for policy in suite if (label := layout.label(policy))]
    if layout.alphas != "all":
        usual = usual_alphas(suite)
        others = [pair for pair in chosen if pair[1] not in usual]
        chosen = [pair for pair in chosen if pair[1] in usual]
        if layout.alphas == "named":
            chosen += [(f"{label}, alpha {policy.alpha}", policy) for label, policy in others]
    tasks = sorted({policy.config.task for _, policy in chosen})
    kinds: dict[tuple[str, bool], list[tuple[str, Evidence]]] = {}
    for label, policy in (pair for task in tasks for pair in _comparable(layout, task, chosen)):
        suite = policy.config.task.split("/")[0]
        kinds.setdefault((suite, policy.config.recipe == "light"), []).append((label, policy))
    return [
        _table(layout, suite, imitation, _same_seeds(layout, kinds[suite, imitation]))
        for suite, imitation in sorted(kinds)
        if suite in SUITES
    ]


def _same_seeds(
    layout: Layout, chosen: Sequence[tuple[str, Evidence]]
) -> list[tuple[str, Evidence]]:
    """All on seeds of one use; those without are named."""
    labels = {policy.path: label for label, policy in chosen}
    same = alike([policy for _, policy in chosen])
    if lacking := labels.keys() - {policy.path for policy in same}:
        say(
            f"{layout.title}: {same[0].seeds} seeds compare most; left out, because measured on "
            f"others: {', '.join(sorted(map(str, lacking)))}"
        )
    return [(labels[policy.path], policy) for policy in same]


def _table(
    layout: Layout, suite: str, imitation: bool, mine: Sequence[tuple[str, Evidence]]
) -> ResultTable:
    """The table of the policies of one suite, each with its row's label."""
    labels = sorted({label for label, _ in mine}, key=rank)
    columns = _columns(layout, [policy for _, policy in mine])
    rows = []
    for task in sorted({policy.config.task for _, policy in mine}, key=_task_rank):
        for label in labels:
            members = [p for name, p in mine if (name, p.config.task) == (label, task)]
            row = row_of(label, columns, members)
            if row.cells:
                rows.append((task, row))
    averages = tuple(_average(label, rows) for label in labels)
    return ResultTable(layout, suite, columns, tuple(rows), averages, imitation)


def _comparable(
    layout: Layout, task: str, chosen: Sequence[tuple[str, Evidence]]
) -> list[tuple[str, Evidence]]:
    """Rows of a task that can be compared: of one recipe and about one budget, and enough of
    them."""
    here = [(label, policy) for label, policy in chosen if policy.config.task == task]
    comparable = []
    for recipe in sorted({policy.config.recipe for _, policy in here}):
        mine = [(label, policy) for label, policy in here if policy.config.recipe == recipe]
        rows: dict[int, set[str]] = {}
        for label, policy in mine:
            rows.setdefault(policy.config.training.updates or 0, set()).add(label)
        near = {u: [few for few in rows if few <= u <= (1 + ALIKE) * few] for u in rows}
        labels = {u: set[str]().union(*(rows[few] for few in near[u])) for u in rows}
        budget = max(rows, key=lambda updates: (len(labels[updates]), updates))
        if len(labels[budget]) >= layout.needs:
            comparable += [p for p in mine if (p[1].config.training.updates or 0) in near[budget]]
    return comparable


def _columns(layout: Layout, policies: Sequence[Evidence]) -> tuple[str, ...]:
    if layout.key != "five":
        return layout.columns
    return ("all", *max((policy.config.streams for policy in policies), key=len))


def _average(label: str, rows: Sequence[tuple[str, Row]]) -> Row:
    """The row of ``label`` over its tasks, with episodes that all of ``rows`` have."""
    seeds = _shared_seeds(rows)
    mine = [row for _, row in rows if row.label == label]
    shared = Row.pooled(label, mine).only(lambda unit: unit[2] in seeds[unit[0]])
    return shared.equal_trainings()


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
    all cameras where there are columns of single ones. A cell has one policy of each training seed:
    the first; others are named and passed over, whatever option sets them apart."""
    row = Row(label)
    first: dict[tuple[str, int], Evidence] = {}
    for policy in members:
        counts = False
        for column in columns:
            # All of one camera is not all cameras, where other rows have several.
            alone = len(policy.config.streams) == 1 and column == "all" and "third_b" in columns
            outcomes = None if alone else policy.of(column)
            if outcomes and first.setdefault((column, policy.seed), policy) is policy:
                units = {(policy.config.task, policy.seed, s): won for s, won in outcomes.items()}
                row.cells.setdefault(column, {}).update(units)
                counts = True
        # A policy that adds no episode is not trained again for this row.
        if counts:
            row.evidence.append(policy)
    passed = [str(policy.path) for policy in members if policy not in row.evidence]
    if passed:
        say(
            f"{label} of {members[0].config.task}: one policy of each training seed counts; passed "
            f"over: {', '.join(sorted(passed))}"
        )
    return row


def usual_alphas(evidence: Sequence[Evidence]) -> list[Evidence]:
    """Without the policies of an alpha ablation: of every task, method, setting and recipe those
    whose alpha is that of the policy whose folder has the plain name; without one, the commonest.
    """
    groups: dict[tuple[str, ...], list[Evidence]] = {}
    for policy in evidence:
        groups.setdefault(_kind(policy), []).append(policy)
    usual = {}
    for key, members in groups.items():
        plain = [p.alpha for p in members if p.folder == p.config.name]
        counted = Counter(policy.alpha for policy in members)
        commonest = min(counted, key=lambda a: (-counted[a], a or 0.0))
        usual[key] = plain[0] if plain else commonest
    return [policy for policy in evidence if policy.alpha == usual[_kind(policy)]]


def _kind(evidence: Evidence) -> tuple[str, ...]:
    """All that policies have in common whose alphas are alternatives."""
    facts = ("task", "method", "setting", "recipe", "merge", "streams")
    return tuple(str(getattr(evidence.config, fact)) for fact in facts)


def _task_rank(task: str) -> tuple[int, str]:
    name = task.split("/")[-1]
    known = name in METAWORLD_TASKS
    return (METAWORLD_TASKS.index(name) if known else len(METAWORLD_TASKS), task)
