"""Figures for files: bars with intervals, lines with bands, curves over an episode.

matplotlib draws them, as SVG text that is the same to the byte whenever it is made from the same
numbers: without a date, a version or random names, and with text as text. Nothing is clipped, so
no reference in it leads outside, and one HTML page can hold several of them. What belongs to
the data is in groups of the class ``bar``, ``dot``, ``line``, ``band`` or ``mark``.

matplotlib takes half a second to import, so that happens when something is drawn.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from html import escape
from io import StringIO
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (
    "#0b6e99",
    "#d9730d",
    "#5c8a3a",
    "#ad1a72",
    "#6940a5",
    "#8f6b4a",
    "#2f9e9e",
    "#777777",
    "#c23b3b",
    "#e58fc0",
    "#a89f1a",
    "#333333",
)
GRID, INK, MARK = "#dddddd", "#222222", "#b8860b"
BAR, PANEL = 13, 230
"""Pixels: the least width of a bar, the width of a panel with lines."""


@dataclass(frozen=True)
class Bar:
    """A rate in [0, 1] and its interval."""

    value: float
    low: float
    high: float
    dots: tuple[float, ...] = ()
    """Single trainings, drawn over the bar."""


@dataclass(frozen=True)
class Line:
    """A curve with a band; all of the same length, y in [0, 1]."""

    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]


def bars(title: str, groups: Sequence[str], series: Mapping[str, Sequence[Bar | None]]) -> str:
    """SVG text; ``series`` has a bar, or None where nothing was measured, for each group."""
    group = max(BAR * (len(series) + 2), 60, *(7 * len(name) for name in groups))
    with _style(title):
        figure = _figure(_width(60 + group * len(groups), title, series), 250)
        axes, step = figure.subplots(), 1 / (len(series) + 2)
        _rate_axis(axes)
        axes.set_xlim(-0.5, len(groups) - 0.5)
        axes.set_xticks(range(len(groups)), groups)
        handles = {}
        for number, (name, row) in enumerate(series.items()):
            colour = COLOURS[number % len(COLOURS)]
            handles[name] = _patch(colour)
            for place, bar in enumerate(row):
                if bar is not None:
                    x = place + (number - (len(series) - 1) / 2) * step
                    _bar(axes, x, 0.85 * step, bar, colour)
        return _finished(figure, title, handles)


def lines(title: str, x_label: str, panels: Mapping[str, Mapping[str, Line]]) -> str:
    """SVG text: a panel for each subset, a line for each method."""
    names = list(dict.fromkeys(name for panel in panels.values() for name in panel))
    colours = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}
    last = max((x for p in panels.values() for line in p.values() for x in line.x), default=1.0)
    with _style(title):
        figure = _figure(_width(50 + PANEL * len(panels), title, names), 270)
        row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (subset, panel) in zip(row, panels.items(), strict=True):
            _rate_axis(axes)
            axes.set_title(subset)
            axes.set_xlabel(x_label)
            axes.set_xlim(0, last or 1.0)
            axes.locator_params(axis="x", nbins=3)
            axes.xaxis.set_major_formatter("{x:,g}")
            for name, line in panel.items():
                colour = colours[name]
                band = axes.fill_between(line.x, line.low, line.high, color=colour, alpha=0.15)
                band.set(linewidth=0, clip_on=False, gid="band")
                axes.plot(line.x, line.y, color=colour, clip_on=False, gid="line")
        return _finished(figure, title, {name: _patch(colours[name]) for name in names})


def curves(
    title: str,
    series: Mapping[str, Sequence[float]],
    colours: Mapping[str, str],
    marks: Mapping[int, str],
    last: int,
    width: int = 760,
    height: int = 150,
) -> str:
    """SVG text: ``series`` has a number for every step from 0 on, NaN where there is none;
    ``marks`` says what happened at a step; the axis ends at step ``last``. The scale is that of the
    data: a Q value has no natural bounds."""
    with _style(title):
        figure = _figure(width, height, layout=None)
        axes = figure.subplots()
        # The same margins in every figure, so that steps lie under each other.
        figure.subplots_adjust(60 / width, 24 / height, 1 - 28 / width, 1 - 26 / height)
        axes.set_title(title, loc="left")
        axes.set_xlim(0, max(last, 1))
        axes.locator_params(axis="x", nbins=6, integer=True)
        axes.locator_params(axis="y", nbins=3)
        axes.xaxis.set_major_formatter("step {x:.0f}")
        axes.grid(axis="y", clip_on=False)
        for step in marks:
            line = axes.axvline(step, color=MARK, linestyle="--", linewidth=1, clip_on=False)
            line.set_gid(f"mark {step}")
        for name, values in series.items():
            axes.plot(values, color=colours[name], label=name, clip_on=False, gid="line")
        if len(series) > 1:
            axes.legend(
                loc="lower right", bbox_to_anchor=(1, 1), ncols=len(series), borderaxespad=0.2
            )
        drawn = _svg(figure)
    for step, words in marks.items():
        group = f'<g class="mark {step}">'
        drawn = drawn.replace(group, f"{group}<title>step {step}: {escape(words)}</title>")
    return drawn


def _style(salt: str) -> AbstractContextManager[None]:
    """matplotlib's settings while a figure is drawn; names inside it are made from ``salt``."""
    import matplotlib

    return matplotlib.rc_context(
        {
            "axes.axisbelow": True,
            "axes.spines.left": False,
            "axes.spines.right": False,
            "axes.spines.top": False,
            "axes.titlesize": "medium",
            "figure.titlesize": "large",
            "font.family": "sans-serif",
            "font.sans-serif": ["DejaVu Sans"],
            "font.size": 8.5,
            "grid.color": GRID,
            "legend.frameon": False,
            "legend.handlelength": 1.0,
            "legend.handleheight": 1.0,
            "lines.linewidth": 1.4,
            "svg.fonttype": "none",
            "svg.hashsalt": salt,
            "text.color": INK,
            "text.parse_math": False,
            "ytick.left": False,
        }
    )


def _figure(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Figure:
    """``width`` and ``height`` in pixels, of which a browser shows 96 to an inch."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width / 96, height / 96), layout=layout)


def _svg(figure: Figure) -> str:
    """Without metadata, and with classes in the place of names that come twice."""
    text = StringIO()
    no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(text, format="svg", metadata=no_metadata)
    drawn = text.getvalue()
    drawn = re.sub(r'<g id="[\w.]+_\d+">', "<g>", drawn[drawn.index("<svg") :])
    return re.sub(r'<g id="([a-z0-9 ]+)">', r'<g class="\1">', drawn)


def _finished(figure: Figure, title: str, handles: Mapping[str, Artist]) -> str:
    """With the title above and the legend at the right."""
    figure.suptitle(title, x=0.01, horizontalalignment="left")
    if handles:
        figure.legend(handles.values(), handles, loc="outside right upper")
    return _svg(figure)


def _patch(colour: str) -> Artist:
    from matplotlib.patches import Patch

    return Patch(color=colour)


def _rate_axis(axes: Axes) -> None:
    """The grid of success rates."""
    axes.set_ylim(0, 1)
    axes.set_yticks([tenth / 10 for tenth in range(0, 11, 2)])
    axes.grid(axis="y", clip_on=False)


def _bar(axes: Axes, x: float, width: float, bar: Bar, colour: str) -> None:
    axes.bar(x, bar.value, width, color=colour, clip_on=False, gid="bar")
    ends = [[max(bar.value - bar.low, 0.0)], [max(bar.high - bar.value, 0.0)]]
    whisker = axes.errorbar(x, bar.value, ends, fmt="none", ecolor=INK, elinewidth=0.8, capsize=2)
    for artist in whisker.get_children():
        artist.set_clip_on(False)
    for dot in bar.dots:
        axes.plot(x, dot, "o", ms=3, mfc="white", mec=INK, mew=0.7, clip_on=False, gid="dot")


def _width(plot: float, title: str, names: Collection[str]) -> float:
    """Pixels that a plot needs with its legend, and its title above."""
    return max(plot + 40 + 6.8 * max(map(len, names), default=0), 8.5 * len(title) + 20)
