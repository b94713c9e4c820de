"""Differences between rows in words, beside the paper's sentences: computed, never typed.

Only the paper's side is written down here. Our side is a paired difference with its 95% interval.
The paper's numbers are means over five trainings by reinforcement learning. So a verdict is given
only on rows that were trained by reinforcement learning too, each of them several times; then it
follows from where the difference's interval lies, the one that stands beside it:

    interval        paper: +0.30       words
    [+0.40, +0.60]  below it           agrees in direction; the lead is larger than the paper's
    [+0.20, +0.45]  inside             agrees, in direction and size
    [+0.02, +0.15]  above it           agrees in direction; the lead is smaller than the paper's
    [-0.05, +0.10]                     undecided: no difference could be shown
    [-0.30, -0.10]                     does not agree: it is behind

Everywhere else the paper's sentence stands beside ours without a verdict; the interval of ours is
about episodes, and other trainings and other tasks would scatter more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from madviz.agent.methods import METHODS
from madviz.measure.statistics import Interval
from madviz.report.layouts import COMPONENTS, MERGES, THREE
from madviz.report.rows import Difference, Row, difference
from madviz.report.tables import ALIKE, ResultTable

BASELINES = ("single", "mvd", "vib", "mv-mwm")
LEAD = {"metaworld": 0.30, "maniskill": 0.36}
"""Paper, section on robustness: MAD's lead over the baselines, in success rate."""
TASKS = {"metaworld": 15, "maniskill": 5}
FIVE_LEAD = 0.48
COMPONENT_LEAD = 0.29
BEST_ALPHA = "alpha 0.8"
SEVERAL = 3
"""Trainings of a row from which on its interval over them says something."""

Judge = Callable[[Interval], str]


def beside(table: ResultTable, gap: Difference, judge: Judge) -> str:
    """``: agrees ...`` where the setting allows a verdict, and otherwise nothing."""
    if table.imitation or len(gap.trainings) < SEVERAL:
        return ""
    return f": {judge(gap.interval)}"


def verdict(interval: Interval, claim: float | None = None) -> str:
    """See the module. Without a ``claim`` the paper gives an order and no size."""
    low, high = interval
    if high < 0:
        return "does not agree: MAD is behind"
    if low <= 0:
        return "undecided: no difference could be shown"
    if claim is None:
        return "agrees: MAD is ahead"
    if low > claim:
        return "agrees in direction; the lead is larger than the paper's"
    if high < claim:
        return "agrees in direction; the lead is smaller than the paper's"
    return "agrees, in direction and size"


def same(interval: Interval, margin: float = 0.1) -> str:
    """Whether a difference counts as none, which takes an interval within ``margin`` of 0."""
    low, high = interval
    if -margin <= low and high <= margin:
        return f"agrees: within {100 * margin:.0f} points of each other"
    if low > 0 or high < 0:
        return "does not agree: they differ"
    return "undecided: the interval is too wide to call them alike"


def claims(table: ResultTable) -> list[str]:
    """Sentences about one table; none where no rows can be paired."""
    return CLAIMS[table.layout.key](table) if table.layout.key in CLAIMS else []


def points(gap: Difference) -> str:
    """``+73 points [+68, +78] on the mean of all, first; n = 100 on 1 task``."""
    tasks = f"{len(gap.tasks)} task{'s' * (len(gap.tasks) > 1)}"
    mean = "the mean of " if len(gap.columns) > 1 else ""
    return f"{gap} on {mean}{', '.join(gap.columns)}; n = {gap.n} on {tasks}"


def _lead(
    table: ResultTable, baselines: Sequence[str], paper: str, claim: float | None = None
) -> list[str]:
    """MAD against each of ``baselines``. The paper's sentence, if there is one, is held against the
    one that comes closest, of those that were trained as long."""
    lines: list[str] = []
    for recipe in _recipes(table):
        fair_gaps = []
        for name in baselines:
            other = _beside_mad(table, name, recipe)
            rows = table.pair(f"mad{recipe}", other)
            if rows and (gap := difference(*rows, table.columns)):
                fair, steps = _steps(*rows, gap.tasks)
                fair_gaps += [gap] if fair else []
                lines.append(f"MAD minus {other}: {points(gap)}{steps}.")
        if fair_gaps and paper:
            closest = min(fair_gaps, key=lambda gap: gap.value)
            judged = beside(table, closest, partial(verdict, claim=claim))
            lines.append(f"The paper reports {paper}{judged}.")
    return lines


def _steps(mad: Row, other: Row, tasks: Sequence[str]) -> tuple[bool, str]:
    """Whether both were trained about as long, and how long each was, where that differs; '' where
    nothing says it, as for imitation."""
    mine, theirs = (
        sorted({policy.config.training.steps or 0 for policy in row.on(tasks).evidence})
        for row in (mad, other)
    )
    if mine == theirs:
        return True, ""
    fair = max(*mine, *theirs) <= (1 + ALIKE) * min(*mine, *theirs)
    unfair = "" if fair else ", so not a fair comparison"
    return fair, f"; after {_either(mine)} and {_either(theirs)} decisions{unfair}"


def _either(numbers: Sequence[int]) -> str:
    return " or ".join(f"{number:,}" for number in numbers)


def _beside_mad(table: ResultTable, name: str, recipe: str) -> str:
    """The label of method ``name`` beside ``mad`` and ``recipe``; where MAD learns by reinforcement
    and its recipes do not train the method, that of the method's own: MV-MWM's."""
    own = METHODS[name].recipes
    if recipe and set(own).isdisjoint(METHODS["mad"].recipes):
        labels = [f"{name}, {own_recipe}" for own_recipe in own]
        return next((label for label in labels if label in table.labels), labels[0])
    return f"{name}{recipe}"


def _recipes(table: ResultTable) -> list[str]:
    """The suffixes after ``mad`` in the labels: '' for the light recipe, ', paper' and so on."""
    return [label.removeprefix("mad") for label in table.labels if label.split(",")[0] == "mad"]


def _overall(table: ResultTable) -> list[str]:
    lead = LEAD[table.suite]
    over = f"{100 * lead:+.0f} points over its baselines, on {TASKS[table.suite]} tasks"
    names = ", ".join(COMPONENTS)
    parts = f"{100 * COMPONENT_LEAD:+.0f} points over {names}, on five Meta-World tasks"
    alike = _one_and_the_same(table)  # A training minus itself says nothing.
    components = [name for name in COMPONENTS if name != "naive-both" or not alike]
    return [
        *_lead(table, BASELINES, over, lead),
        *_lead(table, components, parts if table.suite == "metaworld" else "", COMPONENT_LEAD),
        *_trained_often(table),
        *alike,
    ]


def _trained_often(table: ResultTable) -> list[str]:
    """MAD against each other method, task by task, where both were trained several times. An
    average over tasks has only as many trainings as the task that has fewest."""
    lines = []
    for task in dict.fromkeys(task for task, row in table.rows if row.trainings > 1):
        rows = {row.label: row for at, row in table.rows if at == task and row.trainings > 1}
        mad = rows.pop("mad", None)
        for label, row in rows.items():
            if mad and (gap := difference(mad, row, table.columns)):
                lines.append(
                    f"On {task}, {len(gap.trainings)} trainings of each, MAD minus {label}: "
                    f"{points(gap)}."
                )
    return lines


def _one_and_the_same(table: ResultTable) -> list[str]:
    """Naive Both weighs all rows alike. Where an expert labels, no row is another's teacher, so
    MAD with alpha 1 / (1 + V) is the same training."""
    rows = table.pair("mad", "naive-both")
    if rows is None:
        return []
    mad, both = rows
    tasks = {policy.config.task for policy in both.evidence}
    sentences = [
        f"On {policy.config.task} naive-both and MAD are one and the same training: with alpha "
        f"{policy.alpha:g} MAD weighs the sum and each of "
        f"{len(policy.config.streams)} streams alike, and under the light recipe the expert is the "
        "only teacher, so that nothing else tells them apart."
        for policy in mad.evidence
        if policy.config.task in tasks
        and abs((policy.alpha or 0) - 1 / (1 + len(policy.config.streams))) < 1e-3
    ]
    return list(dict.fromkeys(sentences))  # Several trainings say it once.


def _five(table: ResultTable) -> list[str]:
    paper = f"{100 * FIVE_LEAD:+.0f} points over its baselines with five cameras"
    return _lead(table, BASELINES, paper, FIVE_LEAD)


def _alpha(table: ResultTable) -> list[str]:
    """Task by task, because not every alpha was trained on all of them; and recipe by recipe, which
    a label names after its alpha."""
    alike: dict[tuple[str, str], list[Row]] = {}
    for task, row in table.rows:
        alike.setdefault((task, row.label.partition(",")[2]), []).append(row)
    return [
        sentence
        for (task, _), rows in alike.items()
        if (sentence := _best_alpha(table, task, rows))
    ]


def _best_alpha(table: ResultTable, task: str, rows: Sequence[Row]) -> str:
    """The best alpha among ``rows`` of one task and recipe."""
    # A row of several trainings beside a row of one: another training alone may change the order.
    shared = set.intersection(*(row.training_seeds for row in rows))
    fewer = any(row.training_seeds != shared for row in rows)
    seeds = ", ".join(map(str, sorted(shared)))
    where = f"{task}, with training seed {seeds} alone," if fewer else task
    rows = [row.seeded(shared) for row in rows]
    papers = next((row for row in rows if row.label.split(",")[0] == BEST_ALPHA), None)
    rated = [(rate.value, row) for row in rows if (rate := row.mean(THREE))]
    if papers is None or len(rated) < 2:
        return ""
    best, second, *_ = [row for _, row in sorted(rated, key=lambda pair: -pair[0])]
    other = papers if best is not papers else second
    gap = difference(best, other, THREE)
    if gap is None:
        return ""

    def judge(interval: Interval) -> str:
        if interval[0] <= 0:
            return "undecided: no difference could be shown"
        return "agrees" if best is papers else "does not agree"

    shown = f"{best.label} has the highest mean"
    if gap.interval[0] <= 0:
        shown += ", but no difference shows"
    return (
        f"On {where} {shown}; {best.label} minus {other.label}: "
        f"{points(gap)}. The paper finds {BEST_ALPHA} best{beside(table, gap, judge)}."
    )


def _merging(table: ResultTable) -> list[str]:
    lines = []
    for name in MERGES[1:]:
        if gap := table.difference(name, "sum", ("all",)):
            judge = _behind if name == "q-mean" else same
            lines.append(f"{name} minus sum: {points(gap)}{beside(table, gap, judge)}.")
    if lines:
        lines.append("The paper finds all ways to merge alike, and q-mean slightly worse.")
        lines.append(
            "The row sum is the method merged-only. MAD sums too, but is not in this table."
        )
    return lines


def _behind(interval: Interval) -> str:
    return "agrees: it is behind" if interval[1] < 0 else same(interval)


def _compared(
    table: ResultTable,
    labels: tuple[str, str],
    columns: Sequence[str],
    compared: str,
    paper: str,
    judge: Judge,
) -> list[str]:
    """The difference of two rows, beside the paper's sentence; nothing where a row is missing or no
    episodes can be paired."""
    gap = table.difference(*labels, columns)
    return [f"{compared}: {points(gap)}. {paper}{beside(table, gap, judge)}."] if gap else []


def _occlusion(table: ResultTable) -> list[str]:
    paper = "The paper reports 63% for MAD and 62% for Single Camera"
    lines = []
    for recipe in _recipes(table):
        compared = f"MAD{recipe} minus single, with every camera it has"
        lines += _compared(table, (f"mad{recipe}", "single"), ("all",), compared, paper, same)
    return [*lines, *_blind(table), *_lead(table, ("mvd", "vib"), "MAD far ahead of MVD and VIB")]


def _blind(table: ResultTable) -> list[str]:
    """How much of MAD's loss is on streams alone that see nothing: (1 - alpha) / V for each."""
    blind = {
        alpha: (1 - alpha) * (1 - 1 / len(policy.config.streams))
        for row in table.averages
        for policy in row.evidence
        if policy.config.method == "mad" and (alpha := policy.alpha) is not None
    }
    if not blind:
        return []
    shares = ", ".join(f"{100 * share:.0f}% at alpha {a:g}" for a, share in sorted(blind.items()))
    return [
        "MAD learns from every stream alone, here also from two in which nothing is to be seen; "
        f"their part of its loss is {shares}. Single Camera never meets them."
    ]


def _modality(table: ResultTable) -> list[str]:
    depth = ("mad, one-rgbd", "single, one-depth")
    both = ("mad, one-rgbd", "single, one-rgbd")
    on_depth = "MAD minus single on depth alone"
    on_both = "MAD minus single on colour and depth"
    return [
        *_compared(table, depth, ("depth",), on_depth, "The paper finds MAD ahead", verdict),
        *_compared(table, both, ("all",), on_both, "The paper finds them alike", same),
    ]


def _resolution(table: ResultTable) -> list[str]:
    labels = ("mad", "mad, one size")
    compared = "MAD with mixed sizes minus MAD with one"
    return _compared(table, labels, THREE, compared, "The paper reports no loss", same)


CLAIMS: dict[str, Callable[[ResultTable], list[str]]] = {
    "overall": _overall,
    "scratch": _overall,
    "alpha": _alpha,
    "merging": _merging,
    "merging-two": _merging,
    "occlusion": _occlusion,
    "modality": _modality,
    "five": _five,
    "resolution": _resolution,
}
