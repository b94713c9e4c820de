"""The block of docs/training.md on learning toy/reach from rewards, as results/designs.md fixes it,
from results/rewards.csv (``python tools/designs.py rewards``)."""

from __future__ import annotations

from design_rows import DESIGNS, finished, read_rows
from findings import verdict
from measurements import table
from policy_files import LABELS, ROOT

from madviz.report.layouts import THREE
from madviz.report.rows import Row, difference

NAMES = {
    "mad": "MAD",
    "merged-only": "Merged Only",
    "singular-only": "Singular Only",
    "naive-both": "Naive Both",
    "single": "Single Camera on Third A",
}


def rewards() -> str:
    """The design's outcomes; before all of its trainings are there, how many are."""
    file = ROOT / "results" / "rewards.csv"
    (wanted,) = DESIGNS[file.name].trainings.values()
    if (found := finished(file).total()) < wanted:
        return f"{found} of {wanted} trainings are finished; nothing is said before all are.\n"
    last, ever = (
        {row.label: row for _, row in read_rows(file, outcome)}
        for outcome in ("at_last_step", "at_any_step")
    )
    lines = [
        [
            name,
            *(last[method].rate(column) for column in THREE),
            *(rows[method].mean(THREE) for rows in (last, ever)),
        ]
        for method, name in NAMES.items()
    ]
    alone = [f"{label} alone" for label in LABELS.values()]
    header = ["method", "all cameras", *alone, "mean of these", "the same, at any step"]
    text = table(header, [[cell or "–" for cell in line] for line in lines])
    return f"{text}\n{''.join(f'- {line}' for line in sentences(last, ever))}"


def sentences(last: dict[str, Row], ever: dict[str, Row]) -> list[str]:
    """MAD less each other method, with a verdict on success at the last step."""
    said = []
    for method, name in list(NAMES.items())[1:]:
        columns = ("third_a",) if method == "single" else THREE
        gap, anytime = (difference(rows["mad"], rows[method], columns) for rows in (last, ever))
        assert gap and anytime, "both have all seeds"
        word = verdict("ahead", gap.interval, True, len(gap.trainings))
        where = "on Third A" if method == "single" else "mean of all and single cameras"
        said.append(
            f"MAD minus {name}, {where}: {gap}, at any step {anytime}; {len(gap.trainings)} "
            f"trainings. That MAD is ahead is {word}.\n"
        )
    return said
