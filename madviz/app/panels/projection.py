"""A map of what each camera's picture becomes, with the way of this episode as a fading trail.

Two axes out of thousands, chosen once per policy (``madviz.analysis.projection``), with the same
scale in both directions, so that near on the map is alike in these two directions. A merged
feature that is a sum lies far away from its terms, |M| being up to V times as long; it is drawn
divided by the number of streams in it, which is their middle: drop a camera, and see it move
towards those that are left.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
import viser

from madviz.analysis.projection import DECISIONS, Basis, FeatureMaps
from madviz.app.chart import chart, polyline
from madviz.app.markup import progress_bar
from madviz.app.panels.features import NO_FEATURES, NO_VIEWS
from madviz.app.toolkit import HtmlPanel
from madviz.drawing.colours import MERGED, MUTED, camera_colours
from madviz.session.camera_names import stream_label
from madviz.session.frame import Frame
from madviz.subsets import camera_of, modality_of
from madviz.types import Array, PolicySpec

TRAIL = 60
FADES = (0.12, 0.25, 0.45, 0.8)
"""Time steps a trail goes back; how strongly its quarters are drawn, oldest first."""
WIDTH = 600
MARGIN = 14
"""Units of the drawing; it is stretched to the panel's width as a whole."""


@dataclass(frozen=True)
class Place:
    """Where everything was at one step."""

    step: int
    features: Array
    """(V + 1, Z) float32: the streams, and the merged feature on their scale (NaN: none)."""


class ProjectionPanel(HtmlPanel):
    """One point per stream and one for what they are merged to, on axes that stay."""

    def __init__(self, gui: viser.GuiApi, frame: Frame, height: int = 190) -> None:
        self._height = height
        self._atlas = FeatureMaps()
        self._trail: list[Place] = []
        self._of: tuple[PolicySpec | None, int] = (None, -1)
        """Policy and episode of the trail."""
        self._seen: tuple[int, int] = (-1, -1)
        super().__init__(gui, frame, self._content)

    def _content(self, frame: Frame) -> str:
        if frame.world.probe.merged_kind() == "no views":
            hidden = not frame.world.probe.merged(frame.row).any()
            return f'<div class="mv mv-map">{NO_FEATURES if hidden else NO_VIEWS}</div>'
        key = frame.world.policy
        trail = self._note(frame)
        basis = self._atlas.map(key)
        if basis is None:
            return waiting_html(self._atlas.progress(key))
        return map_html(frame, basis, trail, self._height)

    def _note(self, frame: Frame) -> list[Place]:
        """The trail that leads to this time step, which is added to it, and to the map while that
        is being made. A step that is computed again replaces the trail from there on; one that is
        only shown again changes nothing."""
        key = frame.world.policy
        if self._of != (key, frame.world.episode):
            self._of = (key, frame.world.episode)
            self._trail = []
        if self._seen != (frame.world.episode, frame.world.step) and not frame.past:
            self._atlas.collect(key, frame.world.probe.features)
            self._seen = (frame.world.episode, frame.world.step)
        before = [place for place in self._trail if place.step < frame.world.step]
        trail = [*before, Place(frame.world.step, _points(frame))][-TRAIL:]
        self._trail = self._trail if frame.past else trail
        return trail


def _points(frame: Frame) -> Array:
    """(V + 1, Z): the streams' features and the merged one, brought to the norm of one stream: a
    mean has it, and so has MVD's, which is put together from two halves."""
    probe = frame.world.probe
    row = frame.row
    merged = probe.merged(row)
    if merged.shape != probe.features.shape[1:] or not frame.mask.any():
        merged = np.full(probe.features.shape[1], np.nan, np.float32)
    elif probe.merged_kind() != "mean" and frame.world.policy.method != "mvd":
        merged = merged / frame.mask.sum()
    return np.concatenate([probe.features, merged[None]])


def waiting_html(progress: float) -> str:
    """The sentence that says what is missing until there is a map."""
    done = f"{100 * progress:.0f}"
    return (
        '<div class="mv mv-map"><div>The map is made of the first '
        f"{DECISIONS} time steps that are seen of this policy, and then stays as it is. "
        f"So far {done} %.</div>"
        f"{progress_bar(progress, MUTED)}</div>"
    )


def map_html(frame: Frame, basis: Basis, trail: list[Place], height: int) -> str:
    """The drawing and a line that says how to read it."""
    points = np.stack([basis.project(place.features) for place in trail])
    points = _on_paper(points, basis, height)
    colours = camera_colours(frame.world.env.cameras)
    shapes = ""
    names = ""
    for index, stream in enumerate(frame.world.policy.streams):
        colour = colours[camera_of(stream)]
        depth = modality_of(stream) == "depth"
        shapes += _way(points[:, index], colour, depth)
        shapes += _dot(points[-1, index], colour, bool(frame.mask[index]), 5)
        names += _name(colour, stream_label(frame, stream), depth)
    if np.isfinite(points[-1, -1]).all():
        shapes += _way(points[:, -1], MERGED, False) + _dot(points[-1, -1], MERGED, True, 6)
        names += _name(MERGED, "merged, at the size of one", False)
    return (
        f'<div class="mv mv-map"><div>{names}</div>'
        f"{chart(WIDTH, height, shapes, 'background:#222428')}"
        '<div class="dim">A point is what a picture becomes inside the policy; near means alike. '
        f"These two directions show {100 * basis.share:.0f} % of what changed in the first "
        f"{DECISIONS} time steps. Hollow: dropped.</div></div>"
    )


def _on_paper(points: Array, basis: Basis, height: int) -> Array:
    """(T, N, 2) map coordinates -> drawing units, one scale for both axes, clipped to the paper."""
    span = np.maximum(basis.high - basis.low, 1e-9) * 1.15
    room = np.array([WIDTH - 2 * MARGIN, height - 2 * MARGIN])
    scale = float((room / span).min())
    middle = (basis.high + basis.low) / 2
    paper = np.array([WIDTH / 2, height / 2]) + (points - middle) * [scale, -scale]
    return np.clip(paper, MARGIN / 2, [WIDTH - MARGIN / 2, height - MARGIN / 2])


def _way(points: Array, colour: str, dashed: bool) -> str:
    """A line through (T, 2) points, the older the fainter; steps without a point are gaps."""
    points = points[np.isfinite(points).all(1)]
    if len(points) < 2:
        return ""
    cuts = np.linspace(0, len(points) - 1, len(FADES) + 1).astype(int)
    dash = 'stroke-dasharray="4 3"' if dashed else ""
    return "".join(
        polyline(points[start : end + 1], colour, style=f'stroke-opacity="{fade}" {dash}')
        for start, end, fade in zip(cuts[:-1], cuts[1:], FADES, strict=True)
    )


def _dot(point: Array, colour: str, present: bool, radius: int) -> str:
    fill = colour if present else "none"
    return (
        f'<circle cx="{point[0]:.0f}" cy="{point[1]:.0f}" r="{radius}" fill="{fill}" '
        f'stroke="{colour}" stroke-width="1.6"/>'
    )


def _name(colour: str, label: str, depth: bool) -> str:
    edge = f"border:1.5px dashed {colour};background:none" if depth else f"background:{colour}"
    return f'<span class="dot" style="{edge}"></span>{escape(label)} &nbsp; '
