"""docs/push.svg and docs/push-cube.svg, README's two plots, from the files of the policies, and
docs/soak.svg, memory of the page's server, from those of `madviz soak`.

python tools/figures.py
"""

from __future__ import annotations

import math
from typing import Any

from measurements import read_all
from policy_files import LABELS, ROOT, methods

from madviz.plots.figures import Bar, bars, curves
from madviz.plots.styles import styles
from madviz.report.layouts import THREE
from madviz.report.rows import Row
from madviz.soak.soak import warm_up

DOCS = ROOT / "docs"
SHOWN = {
    "MAD": "mad",
    "Single": "single",
    "Singular Only": "singular-only",
    "MVD": "mvd",
    "Merged Only": "merged-only",
    "VIB": "vib",
}


def figure(title: str, task: str) -> str:
    """SVG text: a group of bars for all cameras and for each one alone, a dot for each training.
    Single is a policy for each camera, and has no bar for all."""
    rows = methods(task)
    series = {name: [_bar(rows[label], group) for group in THREE] for name, label in SHOWN.items()}
    names = ["all cameras", *(f"{label} alone" for label in LABELS.values())]
    mad = rows["mad"]
    measured = f"success at the last step, {mad.trainings} trainings, {mad.seeds} seeds"
    return bars(f"{title}: {measured}", names, series)


def _bar(row: Row, group: str) -> Bar | None:
    rate = row.rate(group)
    if rate is None:
        return None
    trainings = (row.seeded({seed}).rate(group) for seed in sorted(row.training_seeds))
    return Bar(rate.value, *rate.interval, tuple(single.value for single in trainings if single))


def soak_figure() -> str:
    """SVG text: the server's memory after each round of each piece, when nobody visited, against
    what it was after the warm-up; the rounds of that are left out."""
    series = {stem: _changes(soak["memory_mb"]) for stem, soak in read_all("soak/*").items()}
    colours = {name: style.colour for name, style in styles(list(series)).items()}
    last = max(len(rounds) for rounds in series.values()) - 1
    title = "Change of memory since the warm-up, while nobody visits (MB)"
    return curves(title, series, colours, {}, last, height=220, unit="round")


def _changes(memory: dict[str, Any]) -> list[float]:
    rounds = memory["rounds"]
    first = warm_up(len(rounds))
    return [math.nan] * first + [used - memory["after_warm_up"] for used in rounds[first:]]


def main() -> None:
    (DOCS / "push.svg").write_text(figure("Push, small budget", "metaworld/push"))
    (DOCS / "push-cube.svg").write_text(figure("PushCube, small budget", "maniskill/push-cube"))
    if read_all("soak/*"):
        (DOCS / "soak.svg").write_text(soak_figure())


if __name__ == "__main__":
    main()
