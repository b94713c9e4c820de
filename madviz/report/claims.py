"""Where our numbers agree with the paper's sentences, and where not: computed, never typed.

Only the paper's side is written down here. Our side is a paired difference with its 95% interval,
and the words follow from where that interval lies:

    interval        paper: +0.30       words
    [+0.40, +0.60]  below it           agrees in direction; the lead is larger than the paper's
    [+0.20, +0.45]  inside             agrees, in direction and size
    [+0.02, +0.15]  above it           agrees in direction; the lead is smaller than the paper's
    [-0.05, +0.10]                     undecided: no difference could be shown
    [-0.30, -0.10]                     does not agree: it is behind

The interval is about episodes: other trainings and other tasks would scatter more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from madviz.evaluation.statistics import Interval
from madviz.report.layouts import MERGES, THREE
from madviz.report.rows import Difference, Row, difference
from madviz.report.tables import ResultTable

BASELINES = ("single", "mvd", "vib", "mv-mwm")
COMPONENTS = ("naive-both", "merged-only", "singular-only")
LEAD = {"metaworld": 0.30, "maniskill": 0.36}
"""Paper, section on robustness: MAD's lead over the baselines, in success rate."""
TASKS = {"metaworld": 15, "maniskill": 5}
FIVE_LEAD, COMPONENT_LEAD, BEST_ALPHA = 0.48, 0.29, "alpha 0.8"


def verdict(interval: Interval, claim: float) -> str:
    """See the module."""
    low, high = interval
    if high < 0:
        return "does not agree: MAD is behind"
    if low <= 0:
        return "undecided: no difference could be shown"
    if low > claim:
        return "agrees in direction; the lead is larger than the paper's"
    if high < claim:
        return "agrees in direction; the lead is smaller than the paper's"
    return "agrees, in direction and size"


def ahead(interval: Interval) -> str:
    """Where the paper gives an order and no size."""
    low, high = interval
    if low > 0:
        return "agrees: MAD is ahead"
    return "does not agree: MAD is behind" if high < 0 else verdict(interval, 0.0)


def same(interval: Interval, margin: float = 0.1) -> str:
    """Whether a difference counts as none, which takes an interval within ``margin`` of 0."""
    low, high = interval
    if -margin <= low and high <= margin:
        return f"agrees: within {100 * margin:.0f} points of each other"
    if low > 0 or high < 0:
        return "does not agree: they differ"
    return "undecided: the interval is too wide to call them alike"


def claims(table: ResultTable) -> list[str]:
    """Sentences about one table; one saying so where nothing can be said."""
    found = CLAIMS[table.layout.key](table) if table.layout.key in CLAIMS else []
    return found or ["Nothing here can be compared with a sentence of the paper yet."]


def points(gap: Difference) -> str:
    """``+73 points [+68, +78], 100 pairs on 1 task``."""
    low, high = gap.interval
    tasks = f"{len(gap.tasks)} task{'s' * (len(gap.tasks) > 1)}"
    return (
        f"{signed(gap.value)} points [{signed(low)}, {signed(high)}] "
        f"on the mean of {', '.join(gap.columns)}; n = {gap.n} on {tasks}"
    )


def signed(share: float) -> str:
    """Points with their sign; what rounds to nothing is +0, not -0."""
    return f"{round(100 * share) + 0.0:+.0f}"


def _lead(
    table: ResultTable,
    baselines: Sequence[str],
    claim: float | None,
    said: str,
    others: Sequence[str] = (),
) -> list[str]:
    """MAD against each of ``baselines``; the claim is compared with the one that comes closest.
    ``others`` are compared too, but the claim was not about them."""
    lines: list[str] = []
    for recipe in _recipes(table):
        mad = table.average(f"mad{recipe}")
        gaps: list[tuple[str, Difference]] = []
        columns = table.mean_of or table.columns
        for name in (*baselines, *others):
            baseline = table.average(f"{name}{recipe}")
            if mad and baseline and (gap := difference(mad, baseline, columns)):
                gaps.append((name, gap))
        lines += [f"MAD minus {name}{recipe}: {points(gap)}." for name, gap in gaps]
        meant = [each for each in gaps if each[0] in baselines]
        if meant:
            name, gap = min(meant, key=lambda each: each[1].value)
            how = ahead(gap.interval) if claim is None else verdict(gap.interval, claim)
            lines.append(
                f"The paper reports {said}. Against the closest of ours, {name}{recipe}: {how}."
            )
    return lines


def _recipes(table: ResultTable) -> list[str]:
    """What follows ``mad`` in the labels: '' for the light recipe, ', paper' and so on."""
    return [r.label.removeprefix("mad") for r in table.averages if r.label.split(",")[0] == "mad"]


def _overall(table: ResultTable) -> list[str]:
    lead, count = LEAD.get(table.suite, 0.0), TASKS.get(table.suite, 0)
    if not lead:
        return []
    said = (
        f"{100 * lead:+.0f} points over its baselines, by reinforcement learning on {count} tasks"
    )
    lines = [*_lead(table, BASELINES, lead, said, others=COMPONENTS), *_one_and_the_same(table)]
    if not any("closest" in line for line in lines):
        lines.append(
            f"The paper reports {said}. None of these baselines ({', '.join(BASELINES)}) was "
            "measured here on the same episodes, so there is nothing to compare with it yet."
        )
    return lines


def _components(table: ResultTable) -> list[str]:
    said = f"{100 * COMPONENT_LEAD:+.0f} points over all three ablations, on five Meta-World tasks"
    return [*_lead(table, COMPONENTS, COMPONENT_LEAD, said), *_one_and_the_same(table)]


def _one_and_the_same(table: ResultTable) -> list[str]:
    """Naive Both weighs all rows alike. Where an expert labels, no row is another's teacher, so
    MAD with alpha 1 / (1 + V) is the same training."""
    both, mad = table.average("naive-both"), table.average("mad")
    if both is None or mad is None:
        return []
    tasks = {each.task for each in both.evidence}
    return [
        f"On {each.task} naive-both and MAD are one and the same training: with alpha "
        f"{each.alpha:g} MAD weighs the sum and each of {len(each.streams)} streams alike, and "
        "under the light recipe the expert is the only teacher, so that nothing else tells them "
        "apart."
        for each in mad.evidence
        if each.task in tasks and abs((each.alpha or 0) - 1 / (1 + len(each.streams))) < 1e-3
    ]


def _methods(table: ResultTable) -> list[str]:
    everybody = [row.label for row in table.averages if row.label != "mad"]
    return _lead(table, (), None, "", others=everybody)


def _five(table: ResultTable) -> list[str]:
    said = f"{100 * FIVE_LEAD:+.0f} points over its baselines with five views"
    return _lead(table, BASELINES, FIVE_LEAD, said)


def _alpha(table: ResultTable) -> list[str]:
    """Task by task: not every alpha was trained on all of them."""
    tasks = dict.fromkeys(task for task, _ in table.rows)
    each = [_best_alpha(task, [row for at, row in table.rows if at == task]) for task in tasks]
    return [sentence for sentence in each if sentence]


def _best_alpha(task: str, rows: Sequence[Row]) -> str:
    papers = next((row for row in rows if row.label == BEST_ALPHA), None)
    rated = [(rate.value, row) for row in rows if (rate := row.mean(THREE))]
    if papers is None or len(rated) < 2:
        return ""
    best, second, *_ = [row for _, row in sorted(rated, key=lambda each: -each[0])]
    other = papers if best is not papers else second
    gap = difference(best, other, THREE)
    if gap is None:
        return ""
    how = "undecided: no difference could be shown"
    if gap.interval[0] > 0:
        how = "agrees" if best is papers else "does not agree"
    return (
        f"On {task} {best.label} is best; {best.label} minus {other.label}: {points(gap)}. "
        f"The paper finds {BEST_ALPHA} best: {how}."
    )


def _merging(table: ResultTable) -> list[str]:
    base, lines = table.average("sum"), []
    for name in MERGES[1:]:
        row = table.average(name)
        if base and row and (gap := difference(row, base, ("all",))):
            lines.append(f"{name} minus sum: {points(gap)}: {_merge_verdict(name, gap)}.")
    if lines:
        lines.append("The paper finds all ways to merge alike, and q-mean slightly worse.")
    return lines


def _merge_verdict(name: str, gap: Difference) -> str:
    if name == "q-mean" and gap.interval[1] < 0:
        return "agrees: it is behind"
    return same(gap.interval)


def _compared(
    rows: tuple[Row | None, Row | None],
    columns: Sequence[str],
    names: str,
    paper: str,
    judged: Callable[[Interval], str],
) -> list[str]:
    """What the first of two rows has more than the second, and whether the paper's sentence fits;
    nothing where a row is missing or no episodes can be paired."""
    first, second = rows
    gap = difference(first, second, columns) if first and second else None
    return [f"{names}: {points(gap)}. {paper}: {judged(gap.interval)}."] if gap else []


def _occlusion(table: ResultTable) -> list[str]:
    single, said = table.average("single"), "The paper reports 63% and 62%, so no difference"
    lines = []
    for mad in [row for row in table.averages if row.label.split(",")[0] == "mad"]:
        names = f"MAD{mad.label.removeprefix('mad')} minus single, with every camera it has"
        lines += _compared((mad, single), ("all",), names, said, same)
    return [
        *lines,
        *_blind(table),
        *_lead(table, ("mvd", "vib"), None, "MAD far ahead of MVD and VIB"),
    ]


def _blind(table: ResultTable) -> list[str]:
    """How much of MAD's loss is on streams alone that see nothing: (1 - alpha) / V for each."""
    blind = {
        alpha: (1 - alpha) * (1 - 1 / len(each.streams))
        for row in table.averages
        for each in row.evidence
        if each.method == "mad" and (alpha := each.alpha) is not None
    }
    if not blind:
        return []
    shares = ", ".join(f"{100 * share:.0f}% at alpha {a:g}" for a, share in sorted(blind.items()))
    return [
        "MAD learns from every stream alone, here also from two in which nothing is to be seen; "
        f"their part of its loss is {shares}. Single Camera never meets them."
    ]


def _modality(table: ResultTable) -> list[str]:
    mad = table.average("mad, one-rgbd")
    depth, both = table.average("single, one-depth"), table.average("single, one-rgbd")
    names, said = "MAD minus single on depth alone", "The paper finds MAD ahead"
    lines = _compared((mad, depth), ("depth",), names, said, ahead)
    names, said = "MAD minus single on colour and depth", "The paper finds them alike"
    return lines + _compared((mad, both), ("all",), names, said, same)


def _resolution(table: ResultTable) -> list[str]:
    rows = (table.average("mad"), table.average("mad, one size"))
    names, said = "MAD with mixed sizes minus MAD with one", "The paper reports no loss"
    return _compared(rows, THREE, names, said, same)


CLAIMS: dict[str, Callable[[ResultTable], list[str]]] = {
    "overall": _overall,
    "components": _components,
    "alpha": _alpha,
    "methods": _methods,
    "merging": _merging,
    "occlusion": _occlusion,
    "modality": _modality,
    "five": _five,
    "resolution": _resolution,
}
