"""Arrows and rings at a camera in the scene: drag one, and the camera goes along, or turns.

They point along the camera's own axes, as it stands now: to its picture's right and bottom, and
into it. Those of a camera on the hand move with it. While somebody drags, where the arrows are is
what counts; otherwise they are where the camera is. So a picture that was turned on its side, which
no slider does, is upright again on release.

The browser says where the arrows are, and not what of them is held. An arrow leaves the axes as
they were sent to it; the messages take a moment, and a hand turns meanwhile, so axes that differ
from all that were sent lately have been turned by a ring.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser

from madviz.app.panel import Assign, apply
from madviz.app.toolkit import guarded
from madviz.observation.displacement import Displacement, dragged, moved_on, turned
from madviz.session.frame import Frame
from madviz.types import Array, CameraPose

SIZE = 0.25
"""Length of an arrow, as a share of the scene."""
LATELY = 20
"""How many axes are remembered: those of a second or two."""
SAME = float(np.radians(0.1))
"""Radians between two axes that nobody has turned."""


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
        self._frame = frame
        self._on_move = on_move
        self._dragging = False
        self._turning = False
        self._sent: list[Array] = []
        self._handle = scene.add_transform_controls(
            "/moved", SIZE * size, disable_sliders=True, visible=False
        )
        # A coroutine runs in the thread that heard of it; see ``toolkit.Choice``.
        self._handle.on_update(self._hear)

    async def _hear(self, event: viser.TransformControlsEvent) -> None:
        if event.client is not None and self.camera in self._frame.world.poses:
            self._dragging = event.phase != "end"
            guarded(event.client, lambda: self._follow(event.target))
            self._turning = self._turning and self._dragging

    def _follow(self, target: viser.TransformControlsHandle) -> None:
        """Asks for what the arrows say; once they are let go, they stand where the camera will."""
        pose = self._frame.world.poses[self.camera]
        move = self._frame.world.ablation.moves.get(self.camera, Displacement())
        wxyz = np.asarray(target.wxyz, float)
        self._turning = self._turning or self._is_turned(wxyz)
        if self._turning:
            asked = turned(pose, move, wxyz)
        else:
            asked = dragged(pose, move, np.asarray(target.position, float))
        self._on_move(self.camera, asked)
        if not self._dragging:
            apply(self._stand(moved_on(pose, move, asked)))

    def _is_turned(self, wxyz: Array) -> bool:
        """Whether ``wxyz`` (4,) are none of the axes that were sent lately."""
        sent = self._sent or [np.zeros(4)]
        alike = np.abs(np.array(sent) @ wxyz)
        return bool(2 * np.arccos(min(alike.max(), 1.0)) > SAME)

    def update(self, frame: Frame) -> list[Assign]:
        """Shows the arrows where the camera is, unless somebody drags them."""
        self._frame = frame
        if self.camera not in frame.world.poses:
            return [Assign(self._handle, "visible", False)]
        changes = [Assign(self._handle, "visible", True)]
        if not self._dragging:
            changes += self._stand(frame.world.poses[self.camera])
        return changes

    def _stand(self, pose: CameraPose) -> list[Assign]:
        place = np.asarray(pose.position, float)
        wxyz = np.asarray(pose.wxyz, float)
        # A new list, because another thread may look through the old one.
        self._sent = [*self._sent[1 - LATELY :], wxyz]
        return [Assign(self._handle, "position", place), Assign(self._handle, "wxyz", wxyz)]

    def remove(self) -> None:
        self._handle.remove()
