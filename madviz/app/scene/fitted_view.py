"""A visitor's place in the scene, fitted to the window it is seen through."""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.app.panel import Assign, apply
from madviz.drawing.viewpoint import FOV, place_and_target
from madviz.types import Array


class FittedView:
    """A visitor's place, kept fitting while panels dock and windows change, until the visitor
    takes another one."""

    def __init__(self, camera: Any, points: Array, ahead: Array) -> None:
        """``camera`` is a ``viser.CameraHandle``; points (n, 3) must be seen, along ``ahead``
        (3,)."""
        self._camera = camera
        self._points = points
        self._ahead = ahead
        self._aspect = 0.0
        self._place = np.zeros(3)
        apply(self.update())

    def update(self) -> list[Assign]:
        """The changes where the picture has another shape than it had."""
        aspect = _aspect(self._camera)
        if abs(aspect - self._aspect) < 0.01:
            return []
        first = not self._place.any()
        self._aspect = aspect
        away = np.linalg.norm(np.subtract(self._camera.position, self._place)) if not first else 0
        if away > 0.01 * np.linalg.norm(self._place):
            return []  # The visitor has gone to look from elsewhere.
        self._place, target = place_and_target(self._points, self._ahead, aspect)
        return [
            Assign(self._camera, "fov", FOV),
            Assign(self._camera, "position", self._place),
            Assign(self._camera, "look_at", target),
        ]


def _aspect(camera: Any) -> float:
    """Width by height of the scene's picture; before a browser has said, that of a small window."""
    height = getattr(camera, "image_height", 0)
    return camera.image_width / height if height else 0.4
