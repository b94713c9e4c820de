"""Arrows at the gripper: where the policy would move it next with each set of cameras.

Lines from the gripper along the first three numbers of each subset's action: Meta-World's and
ManiSkill's actions are displacements along the axes of the world (the toy has two numbers, and
its arrows are flat). How long an arrow is says how much it would move, not how far in metres: an
action of length 1 is drawn as ``REACH`` of the scene's size, or it would be too small to see.

Gripper, table and objects would hide most of them. Lines have no way to be drawn on top; but a
point moved along the line of sight stays where it is on the screen. So every point is moved towards
the visitor's eye, to ``NEAR`` of its distance, in front of whatever stood in the way; and again
when the visitor looks from somewhere else.

All arrows are one set of line segments. They change at most four times a second and are hidden at
full speed. Thickness is the same for a whole set, so what is to look thick is drawn as several
lines side by side.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import viser

from madviz.analysis.shapley import camera_masks
from madviz.app.panel import Assign, Panel
from madviz.app.toolkit import forget_camera, heard
from madviz.drawing.colours import MERGED, NOTE, camera_colours, rgb
from madviz.session.frame import Frame
from madviz.subsets import camera_of, cameras_of
from madviz.types import Array

PERIOD = 0.25
"""Seconds between two changes of the scene."""
REACH = 0.3
SIDE = 0.008
HEAD = 0.14
"""An action of length 1, and the distance of lines drawn side by side, in scene sizes; an arrow's
head, in arrows."""
NEAR = 0.4
"""Share of the distance to the eye; less would be as good until the visitor is very near."""
DASHES = 5
OTHER = (170, 174, 180)
DIM = 0.85
"""The colour of sets that have none of their own; the share of a colour for untrained sets."""


class ArrowsPanel(Panel):
    """One handle in the scene of one visitor. ``size`` in metres: how large the scene is."""

    def __init__(
        self,
        client: viser.ClientHandle,
        frame: Frame,
        size: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._camera = client.camera
        self._size = size
        self._clock = clock
        self._drawn = -PERIOD
        self._frame = frame
        self._gone = False
        points, colours = arrows(frame, size)
        self._lines = client.scene.add_line_segments(
            "/arrows",
            towards(points, self._eye()),
            colours,
            thickness=3.0,
            thickness_units="screen",
        )
        self._looking = client.camera.on_update(heard(lambda _: self._look()))

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        hidden = frame.pace.speed is None and frame.pace.phase == "playing"
        if hidden:
            return [Assign(self._lines, "visible", False)] if self._lines.visible else []
        now = self._clock()
        if now - self._drawn < PERIOD and frame.pace.phase == "playing":
            return []
        self._drawn = now
        points, colours = arrows(frame, self._size)
        changes = [
            Assign(self._lines, "points", towards(points, self._eye())),
            Assign(self._lines, "colors", colours),
        ]
        return changes if self._lines.visible else [*changes, Assign(self._lines, "visible", True)]

    def remove(self) -> None:
        self._gone = True
        forget_camera(self._camera, self._looking)
        self._lines.remove()

    def _eye(self) -> Array:
        return np.asarray(self._camera.position, float)

    def _look(self) -> None:
        """The visitor looks from somewhere else, and the browser draws everything again anyway."""
        if not self._gone and self._lines.visible:
            points, _ = arrows(self._frame, self._size)
            if len(points) == len(self._lines.points):
                self._lines.points = towards(points, self._eye())


def towards(points: Array, eye: Array, over: float = 1.0) -> Array:
    """(N, 2, 3) -> the same seen from ``eye`` (3,), but nearer to it: later lines the nearest, so
    that they cover the ones before. ``over`` below 1 covers other sets of lines."""
    near = over * np.linspace(NEAR, 0.9 * NEAR, len(points))[:, None, None]
    return (eye + near * (points - eye)).astype(np.float32)


def arrows(frame: Frame, size: float) -> tuple[Array, Array]:
    """(N, 2, 3) float32 points and (N, 2, 3) uint8 colours: the present condition last, on top."""
    points = []
    colours = []
    for row, colour, trained in _drawn_rows(frame):
        action = frame.world.probe.readout.action[row]
        if not np.isfinite(action).all():
            continue
        way = np.zeros(3)
        way[: min(3, len(action))] = action[:3]
        way *= REACH * size
        lines = _arrow(np.asarray(frame.world.hand, float), way)
        if row == frame.row:
            lines = _thick(lines, way, SIDE * size)
        elif not trained:
            lines = _dashed(lines)
            colour = tuple(int(DIM * part) for part in colour)
        points.append(lines)
        colours.append(np.full(lines.shape, linear_in_light(colour), np.uint8))
    if not points:
        return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
    return np.concatenate(points).astype(np.float32), np.concatenate(colours)


def linear_in_light(colour: tuple[int, ...]) -> Array:
    """The colour that viser's browser side turns into ``colour``: it takes the colours of lines,
    and of lines only, for amounts of light, and they would come out pale."""
    return np.round(255 * (np.array(colour) / 255) ** 2.2).astype(np.uint8)


def _drawn_rows(frame: Frame) -> list[tuple[int, tuple[int, ...], bool]]:
    """Row, colour, trained: every set of whole cameras, those with a colour of their own after the
    others, and last the present condition. With half cameras, six streams would have 64 arrows."""
    streams = frame.world.policy.streams
    probe = frame.world.probe
    here = frame.row
    own = camera_colours(frame.world.env.cameras)
    trained = frame.trained_rows
    rows = []
    for mask in camera_masks(streams):
        row = probe.row(mask)
        there = cameras_of(tuple(s for s, on in zip(streams, mask, strict=True) if on))
        colour = rgb(own[camera_of(there[0])]) if len(there) == 1 else OTHER
        colour = rgb(MERGED) if mask.all() else colour
        if row != here:
            rows.append((row, colour, row in trained))
    rows.sort(key=lambda one: one[1] != OTHER)
    return [*rows, (here, rgb(NOTE), True)]


def _arrow(start: Array, way: Array) -> Array:
    """(3, 2, 3): a line and the two of its head."""
    length = np.linalg.norm(way)
    across = np.cross(way, [0.0, 0.0, 1.0])
    if np.linalg.norm(across) < 0.1 * length:
        across = np.cross(way, [1.0, 0.0, 0.0])
    across = across * length / max(float(np.linalg.norm(across)), 1e-9)
    tip = start + way
    back = HEAD * way
    wings = [tip - back + 0.5 * HEAD * sign * across for sign in (1, -1)]
    return np.array([[start, tip], [tip, wings[0]], [tip, wings[1]]])


def _thick(lines: Array, way: Array, side: float) -> Array:
    """The same lines five times: in the middle, and a little to four sides."""
    length = np.linalg.norm(way)
    if length < 1e-9:
        return lines
    first = np.cross(way / length, [0.3, 0.5, 0.81])
    first /= np.linalg.norm(first)
    second = np.cross(way / length, first)
    shifts = [np.zeros(3), *(0.5 * side * s for s in (first, -first, second, -second))]
    return np.concatenate([lines + shift for shift in shifts])


def _dashed(lines: Array) -> Array:
    """The first line as dashes; its head stays."""
    start, tip = lines[0]
    at = np.linspace(0, 1, 2 * DASHES)[:, None]
    dashes = (start + at * (tip - start)).reshape(DASHES, 2, 3)
    return np.concatenate([dashes, lines[1:]])
