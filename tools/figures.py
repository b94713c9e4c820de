"""Pictures of the docs, from files of results: findings.svg, README's plot; loss-and-episodes.svg,
once that design is complete; and soak.svg, memory of the page's server in `benchmarks soak`.

python tools/figures.py
"""

from __future__ import annotations

import math
from typing import Any

from crossed_table import crossed_figure
from findings import judged
from measurements import read_all
from policy_files import ROOT, every_table

from madviz.plots.figures import Bar, curves, dots
from madviz.plots.styles import styles

DOCS = ROOT / "docs"


def findings_figure() -> str:
    """SVG text: the difference and the interval of every claim, by verdict."""
    found = judged(every_table())
    series: dict[str, list[Bar | None]] = {
        said: [
            Bar(one.gap.value, *one.gap.interval) if one.verdict == said else None for one in found
        ]
        for said in dict.fromkeys(one.verdict for one in found)
    }
    title = "Difference of success rates, with its 95 % interval"
    return dots(title, [one.label for one in found], series, signed=True)


def soak_figure() -> str:
    """SVG text: the server's memory after each round of each piece, when nobody visited, against
    what it was after the warm-up; the rounds of that are left out."""
    series = {stem: _changes(soak) for stem, soak in read_all("archive/soak/*").items()}
    colours = {name: style.colour for name, style in styles(list(series)).items()}
    last = max(len(rounds) for rounds in series.values()) - 1
    title = "Change of memory since the warm-up, while nobody visits (MB)"
    return curves(title, series, colours, {}, last, height=220, unit="round")


def _changes(soak: dict[str, Any]) -> list[float]:
    memory = soak["memory_mb"]
    rounds = memory["rounds"]
    first = soak["warm_up"]
    return [math.nan] * first + [used - memory["after_warm_up"] for used in rounds[first:]]


def main() -> None:
    (DOCS / "findings.svg").write_text(findings_figure())
    if picture := crossed_figure():
        (DOCS / "loss-and-episodes.svg").write_text(picture)
    if read_all("archive/soak/*"):
        (DOCS / "soak.svg").write_text(soak_figure())


if __name__ == "__main__":
    main()
