"""How a series looks in every figure: its colour, its marker, and a pattern for its bars.

A label names its series: what stands before the first comma, bracket or ``with`` is looked up in
``STYLES``, so a method has one colour and one marker in all figures. When a method comes a second
time in one figure, its marker is hollow. Whatever has no style of its own, or comes once more,
takes the next of ``SPARE`` that the figure does not have yet.

No two methods have the same marker, and bars may have patterns (``HATCHES``), so that a figure can
be read without colours.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import cycle
from typing import Any

Marker = str | tuple[int, int, float]
"""A shape of matplotlib's: a letter, or corners, 0 for a polygon or 1 for a star, and a turn."""


@dataclass(frozen=True)
class Style:
    """How one series is drawn."""

    colour: str
    marker: Marker
    hollow: bool = False
    """Whether the marker is only an outline: the same method once more, trained otherwise."""
    hatch: str = ""
    """The pattern of its bars, in matplotlib's letters."""


STYLES: dict[str, Style] = {
    "mad": Style("#0b5e86", "o"),
    "single": Style("#e07b18", "s"),
    "mvd": Style("#5c9a3a", "^"),
    "vib": Style("#a3156a", "v"),
    "mv-mwm": Style("#6940a5", "p"),
    "mv-mae": Style("#2f9e9e", "8"),
    "naive-both": Style("#9a6a3f", "D"),
    "merged-only": Style("#1b1b1b", "X"),
    "singular-only": Style("#d8b400", "P"),
    "concat": Style("#8a8a8a", "<"),
    "frame-stack": Style("#c02f2f", ">"),
    "attention": Style("#ee93c4", "*"),
    "vit": Style("#8f8600", "h"),
    "q-mean": Style("#7d92e0", "d"),
    "dropped": Style("#222222", "o"),
    "black": Style("#a8550f", "s"),
    "mean-picture": Style("#2f8fc9", "D"),
    "noise": Style("#b03a8c", "^"),
    "frozen": Style("#5c9a3a", "v"),
    "all": Style("#222222", "o"),
    "first": Style("#c98500", "^"),
    "third_a": Style("#2f8fc9", "s"),
    "third_b": Style("#cc79a7", "D"),
}
"""By method; by what happens to a camera; and for the subsets of three cameras. Those three never
share a figure's legend. A camera has the colour that it has on the page."""
SAME = {"sum": "merged-only"}
"""Other names of a method."""
SPARE = (
    Style("#2f9e9e", "8"),
    Style("#b8571f", (4, 1, 0.0)),
    Style("#5b5bb0", (3, 1, 0.0)),
    Style("#9cc24a", (6, 1, 0.0)),
    Style("#7a1f3d", (5, 1, 180.0)),
    Style("#5fb8e8", (4, 1, 45.0)),
    Style("#4f6b52", (3, 1, 180.0)),
    Style("#c9a0dc", (8, 1, 0.0)),
)
"""For series that are no method, in the order in which they come."""
HATCHES = ("", "///", "...", "xxx", "---", "|||")
"""Hatches of the series in one figure of bars, in their order."""


def styles(labels: Iterable[str], hatched: bool = False) -> dict[str, Style]:
    """A style for every label, which begins with a method's name, ``mad (light)`` or ``Merged
    Only, paper`` for example, or is something else. ``hatched`` gives each a pattern, too."""
    chosen: dict[str, Style] = {}
    for label in labels:
        name = re.split(r"\s*[,(]|\s+with\s", label)[0].lower().replace(" ", "-")
        own = STYLES.get(SAME.get(name, name))
        choices = [] if own is None else [own, replace(own, hollow=True)]
        free = [s for s in (*choices, *SPARE) if s not in chosen.values()]
        chosen[label] = free[0] if free else SPARE[len(chosen) % len(SPARE)]
    if hatched:
        hatches = cycle(HATCHES)
        chosen = {label: replace(look, hatch=next(hatches)) for label, look in chosen.items()}
    return chosen


def marker_words(style: Style) -> dict[str, Any]:
    """matplotlib's words for a series' marker; thin shapes are drawn larger."""
    small = style.marker in ("o", "s", "D", "8", "h", "p")
    return {
        "color": style.colour,
        "marker": style.marker,
        "markersize": 5 if small else 6.5,
        "markerfacecolor": "white" if style.hollow else style.colour,
        "markeredgewidth": 1.2 if style.hollow else 0.4,
        "clip_on": False,
    }
