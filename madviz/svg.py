"""Two kinds of figures as SVG text: bars in groups, and lines with bands, both with intervals.

A plotting library would write its version, the date and random names into the file; a figure that
is committed must come out the same, to the byte, whenever it is made from the same numbers. So this
draws a few rectangles and lines, with every coordinate rounded to a tenth of a pixel.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

COLOURS = (
    *("#0b6e99", "#d9730d", "#5c8a3a", "#ad1a72"),
    *("#6940a5", "#8f6b4a", "#2f9e9e", "#777777", "#c23b3b"),
)
LEFT, TOP, PLOT, GAP, BAR = 46, 40, 170, 22, 13
"""Pixels: left of the first group, above the plot, its height, between groups, a bar's width."""


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


@dataclass
class _Canvas:
    parts: list[str] = field(default_factory=list)

    def text(self, x: float, y: float, words: str, anchor: str = "start", size: int = 11) -> None:
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}">'
            f"{escape(words)}</text>"
        )

    def line(self, x: float, y: float, to_x: float, to_y: float, colour: str = "#222") -> None:
        self.parts.append(
            f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" stroke="{colour}"/>'
        )

    def rect(self, x: float, y: float, width: float, height: float, colour: str) -> None:
        self.parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" '
            f'fill="{colour}"/>'
        )

    def done(self, width: float, height: float) -> str:
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
            f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif" fill="#222">'
        )
        ground = f'<rect width="{width:.0f}" height="{height:.0f}" fill="#fff"/>'
        return "\n".join([head, ground, *self.parts, "</svg>"]) + "\n"


def bars(title: str, groups: Sequence[str], series: Mapping[str, Sequence[Bar | None]]) -> str:
    """``series`` has a bar, or None where nothing was measured, for each of ``groups``."""
    canvas = _Canvas()
    group_width = max(BAR * len(series), 48, *(6 * len(group) - GAP / 2 for group in groups))
    inner = len(groups) * (group_width + GAP)
    width = LEFT + max(inner, 7 * len(title), _legend_width(series)) + 10
    canvas.text(LEFT, 20, title, size=13)
    _rates(canvas, LEFT, LEFT + inner)
    for index, group in enumerate(groups):
        x = LEFT + GAP / 2 + index * (group_width + GAP)
        canvas.text(x + group_width / 2, TOP + PLOT + 15, group, "middle")
        offset = (group_width - BAR * len(series)) / 2
        for number, row in enumerate(series.values()):
            bar = row[index]
            if bar is not None:
                _bar(canvas, x + offset + number * BAR, bar, COLOURS[number % len(COLOURS)])
    height = _legend(canvas, series, TOP + PLOT + 34, width)
    return canvas.done(width, height)


def lines(title: str, x_label: str, panels: Mapping[str, Mapping[str, Line]]) -> str:
    """A panel for each subset, a line for each method, as the paper lays its curves out."""
    canvas, side = _Canvas(), 190
    names = dict.fromkeys(name for panel in panels.values() for name in panel)
    colours = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}
    width = LEFT + max(len(panels) * (side + GAP), 7 * len(title), _legend_width(names)) + 10
    canvas.text(LEFT, 20, title, size=13)
    last = max((x for p in panels.values() for line in p.values() for x in line.x), default=1.0)
    for index, (subset, panel) in enumerate(panels.items()):
        left = LEFT + index * (side + GAP)
        _rates(canvas, left, left + side, label=index == 0)
        canvas.text(left + side / 2, TOP - 6, subset, "middle")
        canvas.text(left + side, TOP + PLOT + 15, f"{last:,.0f} {x_label}", "end", size=9)
        for name, line in panel.items():
            _curve(canvas, line, left, side / (last or 1.0), colours[name])
    height = _legend(canvas, names, TOP + PLOT + 34, width)
    return canvas.done(width, height)


def _y(rate: float) -> float:
    return TOP + PLOT * (1 - rate)


def _rates(canvas: _Canvas, left: float, right: float, label: bool = True) -> None:
    """The grid of success rates."""
    for tenth in (0, 2, 4, 6, 8, 10):
        canvas.line(left, _y(tenth / 10), right, _y(tenth / 10), "#ddd" if tenth else "#222")
        if label:
            canvas.text(left - 6, _y(tenth / 10) + 4, f"{tenth / 10:.1f}", "end")


def _bar(canvas: _Canvas, x: float, bar: Bar, colour: str) -> None:
    canvas.rect(x + 1, _y(bar.value), BAR - 2, PLOT * bar.value, colour)
    middle = x + BAR / 2
    canvas.line(middle, _y(bar.low), middle, _y(bar.high))
    for end in (bar.low, bar.high):
        canvas.line(middle - 2.5, _y(end), middle + 2.5, _y(end))
    for dot in bar.dots:
        canvas.parts.append(
            f'<circle cx="{middle:.1f}" cy="{_y(dot):.1f}" r="2" fill="#fff" stroke="#222"/>'
        )


def _curve(canvas: _Canvas, line: Line, left: float, scale: float, colour: str) -> None:
    def points(values: Sequence[float]) -> list[str]:
        return [f"{left + x * scale:.1f},{_y(y):.1f}" for x, y in zip(line.x, values, strict=True)]

    band = " ".join([*points(line.high), *reversed(points(line.low))])
    canvas.parts.append(f'<polygon points="{band}" fill="{colour}" fill-opacity="0.15"/>')
    curve = " ".join(points(line.y))
    canvas.parts.append(
        f'<polyline points="{curve}" fill="none" stroke="{colour}" stroke-width="1.8"/>'
    )


def _width_of(name: str) -> float:
    return 26 + 6.5 * len(name)


def _legend_width(names: Collection[str]) -> float:
    """What the widest entry needs; longer legends wrap."""
    return max(map(_width_of, names), default=0.0)


def _legend(canvas: _Canvas, names: Collection[str], y: float, width: float) -> float:
    """Draws it from ``y`` on; where the figure ends."""
    x = float(LEFT)
    for index, name in enumerate(names):
        if x > LEFT and x + _width_of(name) > width:
            x, y = float(LEFT), y + 17
        canvas.rect(x, y - 9, 10, 10, COLOURS[index % len(COLOURS)])
        canvas.text(x + 14, y, name)
        x += _width_of(name)
    return y + 14
