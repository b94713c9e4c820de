"""Curves in a panel, as SVG: small, with the ends of their scale as numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from madviz.drawing.colours import FAINT, MUTED


@dataclass(frozen=True)
class Lane:
    """A strip of a drawing with curves on it: its place, and the values that its ends stand for."""

    left: float
    right: float
    top: float
    bottom: float
    last: int
    """The step at the right end; the left end is step 0."""
    low: float
    high: float

    def x(self, step: float) -> float:
        """Where a step is."""
        return self.left + (self.right - self.left) * step / self.last

    def curve(
        self, values: Sequence[float], colour: str, width: float = 1.6, style: str = ""
    ) -> str:
        """A line through one value a step; steps whose value is not finite are left out."""
        height = (self.bottom - self.top) / (self.high - self.low)
        points = (
            (self.x(step), self.bottom - height * (value - self.low))
            for step, value in enumerate(values)
            if np.isfinite(value)
        )
        return polyline(points, colour, width, style)

    def scale(self, digits: str) -> str:
        """The ground line and the values of both ends, in a format such as ``.3g``."""
        ends = ((self.top + 8, self.high), (self.bottom, self.low))
        numbers = "".join(
            f'<text x="{self.left - 6}" y="{y}" text-anchor="end">{value:{digits}}</text>'
            for y, value in ends
        )
        place = f'x1="{self.left}" x2="{self.right}" y1="{self.bottom}" y2="{self.bottom}"'
        return f'<line {place} stroke="{FAINT}"/>{numbers}'


def polyline(
    points: Iterable[tuple[float, float]], colour: str, width: float = 1.6, style: str = ""
) -> str:
    """A line through ``points``, in units of the drawing."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    stroke = f'stroke="{colour}" stroke-width="{width}" {style}'
    return f'<polyline points="{path}" fill="none" {stroke}/>'


def chart(width: int, height: int, content: str, style: str = "") -> str:
    """A drawing of ``width`` x ``height`` units, stretched to the width of its panel."""
    return (
        f'<svg viewBox="0 0 {width} {height}" style="width:100%;display:block;{style}" '
        f'font-size="11" fill="{MUTED}">{content}</svg>'
    )
