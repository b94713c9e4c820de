"""Arrows at a camera in the scene: drag one, and the camera goes along.

They point along the camera's own axes, as it stood in training, so that an arrow does what the
slider of the same direction does. A camera on the hand has them moving with it. While somebody
drags, where the arrows are is what counts; otherwise they are where the camera is.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser

from madviz.app.panel import Assign
from madviz.frame import Frame
from madviz.moves import Displacement, dragged, trained_axes

SIZE = 0.25
"""Length of an arrow, as a share of the scene."""


class Gizmo:
    """For one camera at a time. ``on_move(camera, move)`` is called with what a visitor drags."""

    def __init__(
        self,
        scene: viser.SceneApi,
        frame: Frame,
        size: float,
        on_move: Callable[[str, Displacement], None],
    ) -> None:
        """``size`` in metres, of the whole scene."""
        self.camera = ""
        """Which camera has the arrows; '' for none."""
        self._frame, self._on_move, self._dragging = frame, on_move, False
        self._handle = scene.add_transform_controls(
            "/moved", SIZE * size, disable_rotations=True, disable_sliders=True, visible=False
        )
        # A coroutine runs in the thread that heard of it; see ``toolkit.Choice``.
        self._handle.on_update(self._hear)

    async def _hear(self, event: viser.TransformControlsEvent) -> None:
        if event.client is None or not self.camera:
            return
        self._dragging = event.phase != "end"
        move = self._frame.ablation.moves.get(self.camera, Displacement())
        place = np.asarray(event.target.position, float)
        self._on_move(self.camera, dragged(self._frame.poses[self.camera], move, place))

    def update(self, frame: Frame) -> list[Assign]:
        """Shows the arrows where the camera is, unless somebody drags them."""
        self._frame = frame
        if self.camera not in frame.poses:
            return [Assign(self._handle, "visible", False)]
        changes = [Assign(self._handle, "visible", True)]
        if not self._dragging:
            pose = frame.poses[self.camera]
            axes = trained_axes(pose, frame.ablation.moves.get(self.camera, Displacement()))
            changes += [
                Assign(self._handle, "position", np.asarray(pose.position, float)),
                Assign(self._handle, "wxyz", axes.as_quat(scalar_first=True)),
            ]
        return changes

    def remove(self) -> None:
        self._handle.remove()
