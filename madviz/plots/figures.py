"""Figures for files: bars and dots with intervals, tables of rates, lines, curves over an episode.

matplotlib draws them, as SVG text that is the same to the byte whenever it is made from the same
numbers: without a date, a version or random names, and with text as text. Nothing is clipped, so
no reference in it leads outside, and one HTML page can hold several of them. What belongs to
the data is in groups of the class ``bar``, ``dot``, ``cell``, ``line``, ``band`` or ``mark``.

How a series looks is chosen in ``madviz.plots.styles``.

matplotlib takes half a second to import, so that happens when something is drawn.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from html import escape
from io import StringIO
from itertools import cycle
from typing import TYPE_CHECKING, Literal

from madviz.plots.styles import Style, marker_words, styles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GRID = "#dddddd"
INK = "#222222"
MARK = "#b8860b"
STRIPE = "#f3f3f3"
BAR = 13
PANEL = 230
CELL = (48, 20)
"""Pixels: the least width of a bar, the width of a panel with lines, width and height of a cell."""
MARKERS = 12
"""On a line, at most about so many."""
DASHES = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (6, 1.5, 1, 1.5)))
"""Line styles of the curves in one figure, in their order: they can be told apart without
colours."""


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


def bars(
    title: str,
    groups: Sequence[str],
    series: Mapping[str, Sequence[Bar | None]],
    hatched: bool = False,
) -> str:
    """SVG text; ``series`` has a bar, or None where nothing was measured, for each group.
    ``hatched`` gives each series a pattern of its own, for print without colours."""
    widest = max((len(line) for name in groups for line in name.splitlines()), default=0)
    group = max(BAR * (len(series) + 2), 60, 7 * widest)
    with _style(title):
        figure = _figure(_width(60 + group * len(groups), title, series), 250)
        axes = figure.subplots()
        step = 1 / (len(series) + 2)
        _rate_axis(axes)
        axes.set_xlim(-0.5, len(groups) - 0.5)
        axes.set_xticks(range(len(groups)), groups)
        chosen = styles(series, hatched)
        for name, x, bar in _placed(series, step):
            _bar(axes, x, 0.85 * step, bar, chosen[name])
        return _finished(figure, title, chosen)


def dots(
    title: str,
    groups: Sequence[str],
    series: Mapping[str, Sequence[Bar | None]],
    marks: Collection[float] = (),
    signed: bool = False,
) -> str:
    """SVG text as of ``bars``, with the rates from left to right and a group in each line; the
    rates of ``marks`` are drawn as dashed lines. ``signed``: differences from -1 to 1."""
    crowd = max((sum(map(bool, group)) for group in zip(*series.values(), strict=True)), default=1)
    size = max(20, 9 * crowd + 8)
    left = 30 + 6.2 * max(map(len, groups), default=0)
    with _style(title):
        figure = _figure(_width(left + 430, title, series), 70 + size * len(groups))
        axes = figure.subplots()
        _rate_axis(axes, "x", -1 if signed else 0)
        axes.set_ylim(len(groups) - 0.5, -0.5)
        axes.set_yticks(range(len(groups)), groups)
        for place in range(0, len(groups), 2):
            axes.axhspan(place - 0.5, place + 0.5, color=STRIPE, linewidth=0, zorder=0)
        for rate in marks:
            axes.axvline(rate, color=MARK, linestyle="--", linewidth=1, gid="mark")
        chosen = styles(series)
        for name, y, bar in _placed(series, 0.8 / len(series) if crowd > 1 else 0.0):
            _dot(axes, bar, y, chosen[name])
        for artist in axes.get_children():
            artist.set_clip_on(False)
        return _finished(figure, title, chosen)


def heat(
    title: str,
    rows: Sequence[str],
    columns: Sequence[str],
    panels: Mapping[str, Mapping[str, Sequence[float | None]]],
) -> str:
    """SVG text: a panel for each task, in it a line for each of ``rows``, in it a cell with its
    number for each of ``columns``. Dark is high; a dash is what was not measured."""
    left = 20 + 6.2 * max(map(len, rows), default=0)
    width = left + len(panels) * (CELL[0] * len(columns) + 12)
    with _style(title):
        figure = _figure(max(width, 8.5 * len(title) + 20), 70 + CELL[1] * len(rows))
        boxes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (name, panel) in zip(boxes, panels.items(), strict=True):
            axes.set_title(name)
            axes.set_xlim(-0.5, len(columns) - 0.5)
            axes.set_ylim(len(rows) - 0.5, -0.5)
            axes.set_xticks(range(len(columns)), columns)
            axes.set_yticks(range(len(rows)), rows)
            axes.tick_params(length=0)
            axes.spines["bottom"].set_visible(False)
            for y, row in enumerate(rows):
                for x, rate in enumerate(panel.get(row, [None] * len(columns))):
                    _cell(axes, x, y, rate)
        return _finished(figure, title, {})


def lines(title: str, x_label: str, panels: Mapping[str, Mapping[str, Line]]) -> str:
    """SVG text: a panel for each subset, a line for each method."""
    names = list(dict.fromkeys(name for panel in panels.values() for name in panel))
    chosen = styles(names)
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
                look = chosen[name]
                band = axes.fill_between(line.x, line.low, line.high, color=look.colour, alpha=0.15)
                band.set(linewidth=0, clip_on=False, gid="band")
                every = max(len(line.x) // MARKERS, 1)
                axes.plot(line.x, line.y, color=look.colour, clip_on=False, gid="line")
                axes.plot(line.x[::every], line.y[::every], linestyle="", **marker_words(look))
        return _finished(figure, title, chosen)


def curves(
    title: str,
    series: Mapping[str, Sequence[float]],
    colours: Mapping[str, str],
    marks: Mapping[int, str],
    last: int,
    width: int = 760,
    height: int = 150,
    unit: str = "step",
) -> str:
    """SVG text: ``series`` has a number for every step from 0 on, NaN where there is none;
    ``marks`` says what happened at a step; the axis ends at step ``last``. The scale is that of the
    data: a Q value has no natural bounds. ``unit``: what a step is called."""
    with _style(title):
        figure = _figure(width, height, layout=None)
        axes = figure.subplots()
        # The same margins in every figure, so that steps lie under each other.
        figure.subplots_adjust(60 / width, 24 / height, 1 - 28 / width, 1 - 26 / height)
        axes.set_title(title, loc="left")
        axes.set_xlim(0, max(last, 1))
        axes.locator_params(axis="x", nbins=6, integer=True)
        axes.locator_params(axis="y", nbins=3)
        axes.xaxis.set_major_formatter(f"{unit} {{x:.0f}}")
        axes.grid(axis="y", clip_on=False)
        for step in marks:
            line = axes.axvline(step, color=MARK, linestyle="--", linewidth=1, clip_on=False)
            line.set_gid(f"mark {step}")
        for (name, values), dashes in zip(series.items(), cycle(DASHES)):
            look = {"color": colours[name], "linestyle": dashes, "label": name}
            axes.plot(values, **look, clip_on=False, gid="line")
        if len(series) > 1:
            where = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0.2}
            axes.legend(**where, ncols=len(series), handlelength=3.2)
        drawn = _svg(figure)
    for step, event in marks.items():
        group = f'<g class="mark {step}">'
        drawn = drawn.replace(group, f"{group}<title>{unit} {step}: {escape(event)}</title>")
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


def _finished(figure: Figure, title: str, legend: Mapping[str, Style]) -> str:
    """With the title above and the legend at the right."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    figure.suptitle(title, x=0.01, horizontalalignment="left")
    if legend:
        handles = [
            Patch(facecolor=style.colour, edgecolor="white", hatch=style.hatch)
            if any(look.hatch for look in legend.values())
            else Line2D([], [], linestyle="", **marker_words(style))
            for style in legend.values()
        ]
        figure.legend(handles, list(legend), loc="outside right upper")
    return _svg(figure)


def _rate_axis(axes: Axes, which: Literal["x", "y"] = "y", low: int = 0) -> None:
    """The grid of success rates, or of differences where ``low`` is -1."""
    ticks = [tenth / 10 for tenth in range(10 * low, 11, 2)]
    axes.set(**{f"{which}lim": (low, 1), f"{which}ticks": ticks})
    axes.grid(axis=which, clip_on=False)


def _placed(
    series: Mapping[str, Sequence[Bar | None]], step: float
) -> Iterator[tuple[str, float, Bar]]:
    """Every bar with its series and its place: those of a group side by side around the number of
    the group, ``step`` apart."""
    for number, (name, row) in enumerate(series.items()):
        for group, bar in enumerate(row):
            if bar is not None:
                yield name, group + (number - (len(series) - 1) / 2) * step, bar


def _bar(axes: Axes, x: float, width: float, bar: Bar, style: Style) -> None:
    line = {"edgecolor": "white", "hatch": style.hatch, "linewidth": 0} if style.hatch else {}
    axes.bar(x, bar.value, width, color=style.colour, clip_on=False, gid="bar", **line)
    ends = [[max(bar.value - bar.low, 0.0)], [max(bar.high - bar.value, 0.0)]]
    whisker = axes.errorbar(x, bar.value, ends, fmt="none", ecolor=INK, elinewidth=0.8, capsize=2)
    for artist in whisker.get_children():
        artist.set_clip_on(False)
    shape = {"mfc": "white", "mec": INK, "mew": 0.7, "ms": 5, "clip_on": False}
    axes.plot(x, bar.value, linestyle="", marker=style.marker, **shape)
    for dot in bar.dots:
        axes.plot(x, dot, "o", ms=3, mfc="white", mec=INK, mew=0.7, clip_on=False, gid="dot")


def _dot(axes: Axes, bar: Bar, y: float, style: Style) -> None:
    axes.plot([bar.low, bar.high], [y, y], color=style.colour, linewidth=1.2)
    axes.plot(bar.value, y, linestyle="", gid="dot", **marker_words(style))


def _cell(axes: Axes, x: int, y: int, rate: float | None) -> None:
    import matplotlib
    from matplotlib.patches import Rectangle

    colour = STRIPE if rate is None else matplotlib.colormaps["Blues"](0.05 + 0.9 * rate)
    box = Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=colour, edgecolor="white", gid="cell")
    axes.add_patch(box)
    box.set_clip_on(False)
    ink = "white" if rate is not None and rate > 0.6 else INK
    number = "–" if rate is None else f"{rate:.2f}"
    axes.text(x, y, number, color=ink, ha="center", va="center", clip_on=False)


def _width(plot: float, title: str, names: Collection[str]) -> float:
    """Pixels that a plot needs with its legend, and its title above."""
    return max(plot + 40 + 6.8 * max(map(len, names), default=0), 8.5 * len(title) + 20)
