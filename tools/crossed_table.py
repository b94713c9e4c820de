"""The block and the picture of docs/training.md on losses and recorded episodes, as
results/designs.md fixes them, from results/crossed.csv (``python tools/designs.py crossed``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from design_rows import DESIGNS, design_tables, finished
from findings import ALONE, LEVELS, LOSSES, Finding, judged
from measurements import table
from policy_files import ROOT

from madviz.plots.figures import Bar, dots
from madviz.report.rows import Difference
from madviz.report.tables import ResultTable

FILE = ROOT / "results" / "crossed.csv"
ALPHAS = ("alpha 0.25", "alpha 0.8")
NAMES = {
    "mad, alpha 0.25": "MAD, alpha 0.25",
    "mad, alpha 0.8": "MAD, alpha 0.8",
    "singular-only": "Singular Only",
    "single": "Single Camera",
    "merged-only": "Merged Only",
}
"""The losses, in the order of the picture."""
LEGEND = {
    "turns": "recorded on each alone, too",
    "all": "recorded on all cameras",
}
LOSS = "the loss: MAD minus Merged Only"
EPISODES = "the episodes: *turns* minus *all* (for all losses)"
INTERACTION = "what *turns* adds to MAD minus what it adds to Merged Only"


def comparisons(task: str, alpha: str) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    """The design's five, by their names: the rows of the first side and of the second."""
    mad = [f"mad, {alpha}, {level}" for level in LEVELS]
    merged = [f"merged-only, {level}" for level in LEVELS]
    turns, all_ = ([f"{loss}, {level}" for loss in LOSSES[task]] for level in LEVELS)
    return {
        LOSS: (tuple(mad), tuple(merged)),
        EPISODES: (tuple(turns), tuple(all_)),
        INTERACTION: ((mad[0], merged[1]), (mad[1], merged[0])),
        "MAD minus Singular Only, *turns*": ((mad[0],), ("singular-only, turns",)),
        "MAD minus Single Camera, *turns*": ((mad[0],), ("single, turns",)),
    }


def crossed() -> str:
    """The outcomes of the complete tasks; of the others, how many trainings there are."""
    wanted = DESIGNS[FILE.name].trainings
    found = finished(FILE)
    complete = [task for task in wanted if found[task] >= wanted[task]]
    waiting = [
        f"{task.split('/')[1]}: {found[task]} of {wanted[task]} trainings are finished; nothing is "
        "said before all are.\n"
        for task in wanted
        if task not in complete
    ]
    blocks = []
    if complete:
        names = list(comparisons(complete[0], ALPHAS[0]))
        blocks = [
            "\n".join(f"- {_sentence(task)}" for task in complete) + "\n",
            _compared("on a single camera", complete, ALONE, names),
            _compared("with all cameras", complete, ("all",), names[:-1]),
        ]
    return "\n".join(blocks + waiting)


def _sentence(task: str) -> str:
    """The sentence of results/designs.md on the task, whatever the outcome."""
    tables = design_tables(FILE.parent)
    low, high = (_shown(*_gap(tables, task, ALONE, LOSS, alpha)) for alpha in ALPHAS)
    episodes = _shown(*_gap(tables, task, ALONE, EPISODES, ALPHAS[0]))
    return (
        f"On {task.split('/')[1]}, the loss makes {high} of success from one camera at alpha 0.8, "
        f"and {low} at 0.25. The recorded episodes make {episodes}."
    )


def _shown(gap: Difference) -> str:
    low, high = gap.interval
    return f"{gap}" if low > 0 or high < 0 else f"{gap} (no difference is shown)"


def _compared(
    title: str, tasks: Sequence[str], columns: tuple[str, ...], names: Sequence[str]
) -> str:
    """The comparisons ``names`` on the mean of ``columns``, for each of ``tasks``; – where the
    task has no training of one side."""
    places = [(task, alpha) for task in tasks for alpha in ALPHAS]
    header = [title, *(f"{task.split('/')[1]}, {alpha}" for task, alpha in places)]
    tables = design_tables(FILE.parent)
    lines = []
    for name in names:
        gaps = [_gap(tables, task, columns, name, alpha) for task, alpha in places]
        lines.append([name, *("".join(map(str, gap)) or "–" for gap in gaps)])
    return table(header, lines)


def crossed_figure() -> str:
    """SVG text: success on a single camera by loss and recorded episodes, for the complete tasks;
    '' before there is one."""
    tables = [one for one in design_tables(FILE.parent) if one.layout.key == "crossed"]
    rows = {(task, row.label): row for one in tables for task, row in one.rows}
    if not rows:
        return ""
    places = [(task, loss) for task in LOSSES for loss in NAMES if (task, f"{loss}, turns") in rows]
    labels = [f"{NAMES[loss]} ({task.split('/')[1]})" for task, loss in places]
    series: dict[str, list[Bar | None]] = {}
    for level in LEVELS:
        present = [rows.get((task, f"{loss}, {level}")) for task, loss in places]
        means = (row and row.mean(ALONE) for row in present)
        series[LEGEND[level]] = [
            Bar(mean.value, *mean.interval) if mean else None for mean in means
        ]
    return dots("Success on a single camera, by loss and recorded episodes", labels, series)


def _gap(
    tables: Sequence[ResultTable], task: str, columns: tuple[str, ...], name: str, alpha: str
) -> list[Difference]:
    """The difference of the sides' means; none where a side was not trained. A side of the
    interaction is a sum: that is twice its mean."""
    first, second = (("crossed", side) for side in comparisons(task, alpha)[name])
    gaps = [one.gap for one in judged(tables, [Finding("", task, first, second, columns, "")])]
    if name != INTERACTION:
        return gaps
    return [
        replace(gap, value=2 * gap.value, interval=(2 * gap.interval[0], 2 * gap.interval[1]))
        for gap in gaps
    ]
