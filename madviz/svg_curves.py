"""Curves over the steps of an episode as SVG text, with marks where something happened.

Like the figures of ``madviz.svg`` they come out the same, to the byte, from the same numbers: every
coordinate is rounded to a tenth of a pixel. Unlike there, the scale is that of the data: a Q value
has no natural bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from html import escape

LEFT, RIGHT, TOP, BOTTOM = 52, 12, 26, 22
"""Pixels around the plot."""


def curves(
    title: str,
    series: Mapping[str, Sequence[float]],
    colours: Mapping[str, str],
    marks: Mapping[int, str],
    last: int,
    width: int = 760,
    height: int = 150,
) -> str:
    """``series`` has a number for every step from 0 on, NaN where there is none; ``marks`` says
    what happened at a step; the axis ends at step ``last``."""
    known = [value for line in series.values() for value in line if math.isfinite(value)]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    across, up = width - LEFT - RIGHT, height - TOP - BOTTOM

    def x(step: float) -> float:
        return LEFT + across * step / max(last, 1)

    def y(value: float) -> float:
        return TOP + up * (1 - (value - low) / (high - low))

    parts = [_text(LEFT, 15, title, 12)]
    for value in (low, (low + high) / 2, high):
        parts.append(_line(LEFT, y(value), width - RIGHT, y(value), "#ddd"))
        parts.append(_text(LEFT - 6, y(value) + 4, f"{value:.3g}", 10, "end"))
    parts.append(_text(LEFT, height - 6, "step 0", 10))
    parts.append(_text(x(last), height - 6, f"step {last}", 10, "end"))
    for step, words in marks.items():
        line = _line(x(step), TOP, x(step), TOP + up, "#b8860b", ' stroke-dasharray="3 2"')
        parts.append(f"<g><title>step {step}: {escape(words)}</title>{line}</g>")
    for name, values in series.items():
        parts += _polylines(values, x, y, colours[name])
    parts += _legend(series, colours, width)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="sans-serif" fill="#222">' + "".join(parts) + "</svg>"
    )


def _polylines(
    values: Sequence[float],
    x: Callable[[float], float],
    y: Callable[[float], float],
    colour: str,
) -> list[str]:
    """One for every stretch without a gap."""
    stretches: list[list[str]] = [[]]
    for step, value in enumerate(values):
        if math.isfinite(value):
            stretches[-1].append(f"{x(step):.1f},{y(value):.1f}")
        elif stretches[-1]:
            stretches.append([])
    return [
        f'<polyline points="{" ".join(points)}" fill="none" stroke="{colour}" stroke-width="1.6"/>'
        for points in stretches
        if points
    ]


def _legend(series: Mapping[str, object], colours: Mapping[str, str], width: int) -> list[str]:
    """From the right, in one line."""
    parts, right = [], float(width - RIGHT)
    for name in reversed(list(series)) if len(series) > 1 else ():
        parts.append(_text(right, 15, name, 10, "end"))
        right -= 6.0 * len(name) + 14
        parts.append(f'<rect x="{right:.1f}" y="7.0" width="9" height="9" fill="{colours[name]}"/>')
        right -= 10
    return parts


def _text(x: float, y: float, words: str, size: int, anchor: str = "start") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}">'
        f"{escape(words)}</text>"
    )


def _line(x: float, y: float, to_x: float, to_y: float, colour: str, extra: str = "") -> str:
    return (
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" stroke="{colour}"'
        f"{extra}/>"
    )
