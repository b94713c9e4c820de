"""Move a camera: sliders along its own axes, and back to where the policy was trained.

One camera at a time has the sliders (``breaks.py``); the others stay where they are put. The
picture changes with the slider, and so does what the policy makes of it. Under the sliders stands
how far every camera is from its place, and what that means for the success rates on this page.
"""

from __future__ import annotations

from dataclasses import replace
from html import escape

import viser

from madviz.app.markup import dot
from madviz.app.panel import Assign, Send, apply
from madviz.app.scene.gizmo import Gizmo
from madviz.app.toolkit import Cell, HtmlPanel, SyncedInput, on_use, place
from madviz.drawing.colours import NOTE, camera_colours
from madviz.drawing.viewpoint import extent
from madviz.observation.displacement import LARGEST, MOST_ZOOM, Displacement, MoveCamera
from madviz.session.frame import Frame

HINTS = {
    "forward": "Metres into the picture.",
    "right": "Metres to the picture's right.",
    "up": "Metres to the picture's top.",
    "pan": "Degrees that it turns to the right.",
    "tilt": "Degrees that it turns up.",
    "zoom": "2 shows half as much across, twice as large.",
    "arrows": "Arrows and rings at the camera in the scene: drag one to move or to turn it.",
    "back": "Back to where the policy was trained with it.",
    "all": "All cameras back to where the policy was trained with them.",
}
STEPS = {**dict.fromkeys(("forward", "right", "up"), 0.01), **dict.fromkeys(("pan", "tilt"), 1.0)}
RANGES = {
    **{field: (-most, most, STEPS[field]) for field, most in LARGEST.items()},
    "zoom": (1 / MOST_ZOOM, MOST_ZOOM, 0.05),
}
"""Every slider's first value, last value and step. As far as any command goes, for a slider shows
every move."""


class MovePanel(HtmlPanel):
    """See the module."""

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Send,
        frame: Frame,
        scene: viser.SceneApi | None = None,
    ) -> None:
        """``scene``: where arrows to drag can be shown."""
        self._send = send
        self._frame = frame
        self._gizmo: Gizmo | None = None
        if scene is not None:
            self._gizmo = Gizmo(scene, frame, extent(frame), self._ask)
        self._names = [camera.name for camera in frame.world.env.cameras]
        self._camera = self._names[0]
        self._moves = dict(frame.world.ablation.moves)
        self._sliders: dict[str, viser.GuiSliderHandle] = {}
        self._shown: dict[str, SyncedInput] = {}
        self._add_controls(gui)
        super().__init__(gui, frame, move_html)

    def _add_controls(self, gui: viser.GuiApi) -> None:
        back = gui.add_button("back", hint=HINTS["back"])
        home = gui.add_button("all back", hint=HINTS["all"])
        on_use(back, lambda *_: self._reset([self._camera]))
        on_use(home, lambda *_: self._reset(self._names))
        cells = []
        for field, (low, high, step) in RANGES.items():
            value = getattr(self._move, field)
            slider = gui.add_slider(field, low, high, step, value, marks=(), hint=HINTS[field])
            on_use(slider, lambda _, value, field=field: self._drag(field, value))
            self._sliders[field], self._shown[field] = slider, SyncedInput(slider)
        cells += [
            Cell(slider, 1 + 6 * (index % 2), 6)
            for index, slider in enumerate(self._sliders.values())
        ]
        if self._gizmo is not None:
            arrows = gui.add_checkbox("arrows", False, hint=HINTS["arrows"])
            on_use(arrows, lambda _, on: self._show_arrows(bool(on)))
            cells.append(Cell(arrows, 1, 4))
        cells += [Cell(back, 5, 4), Cell(home, 9, 4)]
        self.handles = place(gui, "move", 12, cells)

    @property
    def _move(self) -> Displacement:
        return self._moves.get(self._camera, Displacement())

    def choose(self, camera: str) -> None:
        """Gives the sliders to ``camera``."""
        self._camera = camera
        self._release()
        if self._gizmo is not None and self._gizmo.camera:
            self._show_arrows(True)
        # No frame may come while an episode is paused, so this does not wait for one.
        apply(self._show_sliders())

    def _drag(self, field: str, value: float) -> None:
        self._shown[field].hold(value)
        move = replace(self._move, **{field: value})
        self._moves[self._camera] = move
        self._ask(self._camera, move)

    def _show_arrows(self, on: bool) -> None:
        assert self._gizmo is not None
        self._gizmo.camera = self._camera if on else ""
        self.show(self._gizmo.update(self._frame))

    def _release(self) -> None:
        for shown in self._shown.values():
            shown.release()

    def _reset(self, cameras: list[str]) -> None:
        self._release()
        for camera in cameras:
            self._moves.pop(camera, None)
            self._ask(camera, None)

    def _ask(self, camera: str, move: Displacement | None) -> None:
        self._send(MoveCamera(camera, move))

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        changes = super().update(frame)
        changes += self._gizmo.update(frame) if self._gizmo is not None else []
        now = frame.world.ablation.moves.get(self._camera, Displacement())
        if all(shown.confirms(getattr(now, field)) for field, shown in self._shown.items()):
            self._moves = dict(frame.world.ablation.moves)
            changes += self._show_sliders()
        return changes

    def _show_sliders(self) -> list[Assign]:
        move = self._move
        changes = []
        for field, shown in self._shown.items():
            changes += shown.show(getattr(move, field), shown.handle.value != getattr(move, field))
        return changes

    def remove(self) -> None:
        super().remove()
        if self._gizmo is not None:
            self._gizmo.remove()


def move_html(frame: Frame) -> str:
    """Where cameras are, and what becomes of the success rates."""
    if not frame.world.ablation.moves:
        return (
            '<div class="mv mv-moved"><span class="dim">Every camera stands where the policy was '
            "trained. Move one: picture, action and Q change at once.</span></div>"
        )
    colours = camera_colours(frame.world.env.cameras)
    moves = frame.world.ablation.moves
    rows = "".join(
        f"<div>{dot(colours[camera.name])}"
        f"<b>{escape(camera.label)}</b> {escape(moves[camera.name].words())}</div>"
        for camera in frame.world.env.cameras
        if camera.name in moves
    )
    return (
        f'<div class="mv mv-moved" style="border-left:3px solid {NOTE};margin:0 10px;'
        f'padding:2px 8px">{rows}<div class="dim">A condition of its own: its success is that of '
        "whole episodes with the cameras there. Success against distance: "
        f"<code>{escape(sweep(frame, frame.world.reference))}</code></div></div>"
    )


def sweep(frame: Frame, policy: str) -> str:
    """The command that measures success of ``policy`` on the way to where the first moved camera
    stands, along the first of its axes that it went; the others it leaves as they were."""
    camera = next(c.name for c in frame.world.env.cameras if c.name in frame.world.ablation.moves)
    moved = frame.world.ablation.moves[camera]
    way = next(name for name in RANGES if name in moved.changed)
    low, high = sorted((getattr(Displacement(), way), moved.changed[way]))
    return (
        f"madviz audit --policy {policy} --along {camera}.{way}={low:g}:{high:g} --out audit-{way}"
    )
