"""The features of the pictures: their norms, the merged feature and its terms.

The strips show where a feature is active: its Z numbers in ``BINS`` groups, the mean size of each.
All strips share one colour scale, so that a stream that adds little looks dark.

How features become one is read from the numbers (``Probe.merged_kind``), not from a policy's name:
only of a sum may the page say that it is one, and only a sum has shares.
"""

from __future__ import annotations

from base64 import b64encode
from html import escape

import cv2
import numpy as np
import viser
from viser import uplot

from madviz.agent.merges.merge_table import MERGES
from madviz.agent.methods import METHODS
from madviz.app.markup import dot, term
from madviz.app.panel import Assign
from madviz.app.toolkit import HtmlPanel
from madviz.drawing.colours import MERGED, camera_colours, heat
from madviz.session.camera_names import stream_label
from madviz.session.frame import Frame
from madviz.subsets import camera_of, modality_of
from madviz.types import Array

BINS = 128
"""Columns of a strip."""
FONT = "11px sans-serif"
NO_VIEWS = (
    "This policy puts the pictures of all cameras on top of each other before anything else. No "
    "camera has a feature of its own, so there is only one row here, and no camera can be left out."
)
NO_FEATURES = "This policy does not show what it makes of single cameras."
NO_POINTS = uplot.Series_Points(show=False)
WHOLE = tuple(part * 10**power for power in range(5) for part in (1, 2, 5))
"""Distances of the numbers on an axis of steps or episodes."""


def small_axes(width: int, label: str = "") -> tuple[uplot.Axis, uplot.Axis]:
    """Axes for a chart that has little room; ``width`` in pixels of the numbers on the left,
    ``label`` under the lower axis."""
    ticks = uplot.Axis_Ticks(size=4)
    below = uplot.Axis(size=22, font=FONT, gap=3, ticks=ticks, incrs=WHOLE)
    if label:
        below |= uplot.Axis(label=label, labelFont=FONT, labelSize=16, labelGap=2)
    return below, uplot.Axis(size=width, font=FONT, gap=3, ticks=ticks)


class FeaturesPanel(HtmlPanel):
    """Curves of norms over this episode and, below them, a table: strip, norm and cosine of every
    stream."""

    def __init__(self, gui: viser.GuiApi, frame: Frame, height: int = 150) -> None:
        self._gui = gui
        self._height = height
        self._streams: tuple[str, ...] = ()
        self._plot: viser.GuiUplotHandle
        self._history: list[tuple[float, ...]] = []
        self._episode = 0
        self._holder = gui.add_folder(None)
        self._rebuild(frame)
        self.handles = [self._holder]
        super().__init__(gui, frame, features_html)

    def update(self, frame: Frame) -> list[Assign]:
        if frame.world.policy.streams != self._streams:
            self._rebuild(frame)
        self.note(frame)
        changes = super().update(frame)
        if len(self._history) > 1:
            changes.append(Assign(self._plot, "data", tuple(np.array(self._history).T)))
        return changes

    def note(self, frame: Frame) -> None:
        """Takes a point for the curves. An earlier step that is shown again has its point
        already."""
        if frame.past or frame.world.policy.streams != self._streams:
            return
        if frame.world.episode != self._episode:
            self._episode = frame.world.episode
            self._history.clear()
        # The same time step, perhaps under another condition, or what came after it before.
        while self._history and self._history[-1][0] >= frame.world.step:
            self._history.pop()
        self._history.append((frame.world.step, *curve_point(frame)))

    def _rebuild(self, frame: Frame) -> None:
        """Another policy may have other streams, and with them other curves."""
        if self._streams:
            self._plot.remove()
        self._history.clear()
        self._streams = frame.world.policy.streams
        count = len(self._streams) + 2
        with self._holder:
            self._plot = self._gui.add_uplot(
                tuple(np.array([0.0, 1.0]) if i == 0 else np.zeros(2) for i in range(count)),
                curve_series(frame),
                scales={"x": uplot.Scale(time=False)},
                axes=small_axes(42, "step of this episode"),
                legend=uplot.Legend(show=False),
                height=self._height - 12 * max(0, len(self._streams) - 3),
                padding=(8, 12, 0, 0),
            )


def curve_series(frame: Frame) -> tuple[uplot.Series, ...]:
    """One line per stream in its camera's colour, depth dashed, the merged feature in white."""
    colours = camera_colours(frame.world.env.cameras)
    series: list[uplot.Series] = [uplot.Series(label="step")]
    for stream in frame.world.policy.streams:
        line = uplot.Series(
            label=stream_label(frame, stream),
            stroke=colours[camera_of(stream)],
            width=2,
            points=NO_POINTS,
        )
        if modality_of(stream) == "depth":
            line["dash"] = (6, 4)
        series.append(line)
    series.append(uplot.Series(label="merged", stroke=MERGED, width=2, points=NO_POINTS))
    return tuple(series)


def curve_point(frame: Frame) -> list[float]:
    """The term of every stream in the sum now, and the sum: a dropped stream adds nothing."""
    norms = np.where(frame.mask, frame.world.probe.norms, 0.0)
    return [*map(float, norms), frame.world.probe.merged_norm(frame.row)]


def merged_words(frame: Frame) -> str:
    """``merged: their sum``, or however else this policy does it."""
    kind = frame.world.probe.merged_kind()
    if kind == "sum":
        return "merged: their sum"
    if kind == "mean":
        return "their mean (not merged)"
    method = METHODS.get(frame.world.policy.method)
    how = MERGES[method.merge].cell_words if method else ""
    return f"merged: {how}" if how else "merged"


def features_html(frame: Frame) -> str:
    """A row per stream and one for what they are merged to."""
    probe = frame.world.probe
    row = frame.row
    mask = frame.mask
    colours = camera_colours(frame.world.env.cameras)
    merged = probe.merged(row)
    terms = [_bins(feature) for feature in probe.features]
    top = max(float(np.max(np.concatenate([*terms, _bins(np.nan_to_num(merged))]))), 1e-9)
    cosines = probe.cosines(row)
    shares = 100 * probe.shares(row)
    alone = probe.merged_kind() == "no views"
    rows = []
    for index, stream in enumerate(() if alone else frame.world.policy.streams):
        numbers = (
            f"{probe.norms[index]:.1f}",
            f"{cosines[index]:.2f}" if np.isfinite(cosines[index]) else "–",
            f"{shares[index]:.0f} %" if np.isfinite(shares[index]) else "–",
        )
        label = escape(stream_label(frame, stream)) + ("" if mask[index] else " · dropped")
        colour = colours[camera_of(stream)]
        rows.append(_row(colour, label, terms[index] / top, numbers, faded=not mask[index]))
    whole = "100 %" if np.isfinite(shares).all() else ""
    numbers = (f"{probe.merged_norm(row):.1f}", "", whole)
    rows.append(_row(MERGED, merged_words(frame), _bins(merged) / top, numbers, False))
    if alone and not merged.any():
        return f'<div class="mv"><div class="boxed">{NO_FEATURES}</div></div>'
    note = f'<div class="boxed">{NO_VIEWS}</div>'
    return f'<div class="mv">{note if alone else ""}<table>{_HEAD}{"".join(rows)}</table></div>'


_HEAD = (
    '<tr class="dim"><td>stream</td><td style="width:42%">where its feature is active</td>'
    f'<td class="num">{term("norm")}</td><td class="num">{term("cosine")}</td>'
    f'<td class="num">{term("share")}</td></tr>'
)


def _row(colour: str, label: str, strip: Array, numbers: tuple[str, ...], faded: bool) -> str:
    style = "opacity:0.45" if faded else ""
    cells = "".join(f'<td class="num">{number}</td>' for number in numbers)
    return (
        f'<tr style="{style}"><td>{dot(colour)}'
        f'{label}</td><td><img class="strip" alt="" src="{strip_uri(strip)}"></td>{cells}</tr>'
    )


def _bins(feature: Array) -> Array:
    """(Z,) -> (BINS,) mean absolute activity; fewer where Z is smaller."""
    edges = np.linspace(0, len(feature), min(BINS, len(feature)), endpoint=False).astype(int)
    return np.add.reduceat(np.abs(feature), edges) / np.diff(np.append(edges, len(feature)))


def strip_uri(strip: Array) -> str:
    """A one-pixel-high heat map as an inline picture."""
    picture = heat(np.sqrt(strip)[None], cv2.COLORMAP_INFERNO)
    _, png = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return "data:image/png;base64," + b64encode(png.tobytes()).decode()
