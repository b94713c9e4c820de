"""The hand's path in an episode in which a camera was changed, and its path with all cameras.

The path of the episode is a thick line, the one with all cameras a thin white line over it; both
begin where a camera was first changed. Of two policies that are compared, B's thick line has
another colour, in the same scene. As with the arrows, points are moved towards the visitor's eye,
or the gripper and the table would hide most of them.
"""

from __future__ import annotations

import numpy as np
import viser

from madviz.app.panel import Assign, Panel
from madviz.app.scene.arrows import linear_in_light, towards
from madviz.app.toolkit import forget_camera, heard
from madviz.drawing.colours import MERGED, NOTE, rgb
from madviz.session.frame import Frame, HandPaths
from madviz.types import Array

COLOURS = (NOTE, "#b58cff")
"""The colours of A's path and of B's."""
THICK = 6.0
THIN = 2.0
"""Pixels."""
OVER = 0.8
"""The distance of thin lines to the eye, in that of thick ones."""
NO_PATH = np.zeros((1, 3), np.float32)


class PathsPanel(Panel):
    """Two lines for each side, in the scene of one visitor."""

    def __init__(self, client: viser.ClientHandle, frame: Frame) -> None:
        self._camera = client.camera
        self._gone = False
        self._lines = [
            client.scene.add_line_segments(
                f"/paths/{side}/{name}",
                np.zeros((0, 2, 3), np.float32),
                np.zeros((0, 2, 3), np.uint8),
                thickness=pixels,
                thickness_units="screen",
            )
            for side in "ab"
            for name, pixels in (("taken", THICK), ("intact", THIN))
        ]
        self._shown: tuple[HandPaths | None, HandPaths | None] = (None, None)
        self._looking = client.camera.on_update(heard(lambda _: self._look()))

    def update(self, frame: Frame) -> list[Assign]:
        paths = (frame.paths, frame.second.paths if frame.second is not None else None)
        if paths == self._shown:
            return []
        self._shown = paths
        changes = []
        colours = [rgb(tone) for colour in COLOURS for tone in (colour, MERGED)]
        for line, points, colour in zip(self._lines, self._points(), colours, strict=True):
            changes += [
                Assign(line, "points", points),
                Assign(line, "colors", np.full(points.shape, linear_in_light(colour), np.uint8)),
            ]
        return changes

    def remove(self) -> None:
        self._gone = True
        forget_camera(self._camera, self._looking)
        for line in self._lines:
            line.remove()

    def _points(self) -> list[Array]:
        """(T - 1, 2, 3) for each line, as seen from where the visitor stands."""
        eye = np.asarray(self._camera.position, float)
        points = []
        for paths in self._shown:
            taken, intact = (paths.taken, paths.intact) if paths is not None else (NO_PATH, NO_PATH)
            points.append(towards(segments(taken), eye))
            points.append(towards(segments(intact), eye, OVER))
        return points

    def _look(self) -> None:
        """The visitor looks from somewhere else."""
        if not self._gone and any(self._shown):
            for line, points in zip(self._lines, self._points(), strict=True):
                line.points = points


def segments(path: Array) -> Array:
    """(T, 3) -> (T - 1, 2, 3): the lines between neighbours."""
    return np.stack([path[:-1], path[1:]], axis=1)
