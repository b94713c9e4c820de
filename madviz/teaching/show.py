"""The values that a lesson shows: pictures, figures, tables and source, each a value that draws
itself.

A notebook asks a value for ``_repr_png_``, ``_repr_svg_`` or ``_repr_html_`` and shows the first it
knows; a page that only displays saved notebooks does the same. So the objects here do not need
Jupyter, the pictures stay small (a sheet of three cameras is some 20 kB), and each of them also has
``html``, which a widget can show.
"""

from __future__ import annotations

import inspect
import textwrap
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from madviz.errors import UserError
from madviz.measure.statistics import wilson
from madviz.plots import figures
from madviz.types import Array

LABEL = 18
"""Pixels of the words above a picture in a sheet."""
GAP = 6
MARK = {0: "⬛", 1: "🟩"}


@dataclass(frozen=True)
class Picture:
    """An image with words for those who cannot see it."""

    pixels: Array
    """(H, W, 3) uint8."""
    words: str = "a picture"

    @property
    def html(self) -> str:
        source = b64encode(self._repr_png_()).decode()
        return f'<img alt="{escape(self.words)}" src="data:image/png;base64,{source}">'

    def __repr__(self) -> str:
        return f"[{self.words}]"

    def _repr_png_(self) -> bytes:
        return png(self.pixels)


@dataclass(frozen=True)
class Figure:
    """A drawing as SVG text."""

    svg: str
    words: str = "a figure"

    @property
    def html(self) -> str:
        return self.svg

    def __repr__(self) -> str:
        return f"[{self.words}]"

    def _repr_svg_(self) -> str:
        return self.svg


@dataclass(frozen=True)
class TextTable:
    """Rows of words; in a terminal, columns of plain text."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def html(self) -> str:
        def row(cells: Sequence[str], tag: str) -> str:
            return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"

        body = "".join(row(cells, "td") for cells in self.rows)
        return f"<table>{row(self.head, 'th')}{body}</table>"

    def __repr__(self) -> str:
        lines = [self.head, *self.rows]
        widths = [max(len(line[i]) for line in lines) for i in range(len(self.head))]
        padded = [[cell.ljust(w) for cell, w in zip(line, widths, strict=True)] for line in lines]
        return "\n".join("  ".join(cells).rstrip() for cells in padded)

    def _repr_html_(self) -> str:
        return self.html


@dataclass(frozen=True)
class Source:
    """Python text, shown with colours where there are any."""

    text: str

    def __repr__(self) -> str:
        return self.text

    def _repr_markdown_(self) -> str:
        return f"```python\n{self.text}\n```"


class Words(str):
    """A sentence that a notebook shows without quotes."""

    def __repr__(self) -> str:
        return str(self)


def source(*things: Any) -> Source:
    """The code that ships, of functions, methods, classes or modules; nothing is a copy."""
    return Source(
        "\n\n".join(textwrap.dedent(inspect.getsource(thing)).rstrip() for thing in things)
    )


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> TextTable:
    """A table of anything; numbers that are not whole get two digits."""
    return TextTable(tuple(head), tuple(tuple(_cell(value) for value in row) for row in rows))


def _cell(value: Any) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.2f}"
    return str(value)


def sheet(pictures: Mapping[str, Array], size: int = 168, columns: int = 0) -> Picture:
    """Labelled pictures side by side, each (H, W, 3) or (H, W, 1) uint8 and enlarged to ``size``
    pixels without smoothing: the network's own pixels. ``columns`` wraps long rows."""
    if not pictures:
        raise UserError("expected one or more pictures, found none")
    columns = columns or len(pictures)
    rows = -(-len(pictures) // columns)
    canvas = np.full((rows * (size + LABEL + GAP) - GAP, columns * (size + GAP) - GAP, 3), 255)
    canvas = canvas.astype(np.uint8)
    for index, (label, pixels) in enumerate(pictures.items()):
        top = index // columns * (size + LABEL + GAP)
        left = index % columns * (size + GAP)
        canvas[top : top + LABEL, left : left + size] = _label(label, size)
        colour = np.broadcast_to(pixels, (*pixels.shape[:2], 3)).astype(np.uint8)
        enlarged = cv2.resize(colour, (size, size), interpolation=cv2.INTER_NEAREST)
        canvas[top + LABEL : top + LABEL + size, left : left + size] = enlarged
    return Picture(canvas, "pictures: " + ", ".join(pictures))


def _label(words: str, width: int) -> Array:
    image = Image.new("RGB", (width, LABEL), "white")
    ImageDraw.Draw(image).text((1, 2), words, fill="black", font=ImageFont.load_default(12))
    return np.asarray(image)


def bars(
    title: str,
    groups: Sequence[str],
    series: Mapping[str, Sequence[float | tuple[int, int] | None]],
) -> Figure:
    """Bars in groups. A pair (successes, n) becomes a rate with its Wilson interval; a number in
    [0, 1] stands for itself; where there is None there is no bar."""
    made = {name: [_bar(value) for value in values] for name, values in series.items()}
    lines = [group.replace(" + ", " +\n") for group in groups]
    return Figure(figures.bars(title, lines, made, hatched=True), f"bars: {title}")


def _bar(value: float | tuple[int, int] | None) -> figures.Bar | None:
    if value is None:
        return None
    if isinstance(value, tuple):
        successes, n = value
        return figures.Bar(successes / n if n else 0.0, *wilson(successes, n))
    return figures.Bar(float(value), float(value), float(value))


def curves(title: str, x_label: str, lines: Mapping[str, tuple[Sequence[float], Sequence[float]]]):
    """Lines of (x, y) in one panel, scaled so that the highest y is 1; the title should say so."""
    top = max((max(y) for _, y in lines.values()), default=1.0) or 1.0
    panel = {}
    for name, (x, y) in lines.items():
        scaled = [value / top for value in y]
        panel[name] = figures.Line(list(x), scaled, scaled, scaled)
    return Figure(figures.lines(title, x_label, {"": panel}), f"curves: {title}")


def png(pixels: Array) -> bytes:
    """(H, W, 3) RGB uint8 -> a PNG file of at most 256 colours: a third of the size, and in
    pictures of a scene the difference is hardly visible."""
    data = BytesIO()
    Image.fromarray(pixels).quantize(256, dither=Image.Dither.NONE).save(data, "PNG", optimize=True)
    return data.getvalue()


Drawable = Picture | Figure | TextTable
Draws = Callable[..., Drawable]
