"""How one camera is broken: what it sends, how much of it, where it stands.

*break …* under a picture opens it for that camera; once more, or *close*, closes it. The others
stay as they are.
"""

from __future__ import annotations

from dataclasses import replace

import viser

from madviz.app.panel import Assign, Send
from madviz.app.panels.move import MovePanel
from madviz.app.toolkit import Cell, Choice, SyncedInput, WidgetPanel, on_use, place
from madviz.observation.ablation import KINDS, PLACE, CameraState, Occlusion
from madviz.session.commands import SetCamera
from madviz.session.frame import Frame, untouched

GIVES = {"rgb": "RGB", "depth": "depth", "both": "both"}
SLIDERS = ("strength", *PLACE)
"""The fractions of an occlusion; each has a slider, which shows where its kind uses it."""
HINTS = {
    "sends": "A failing camera: it stays in the sum, but sends a broken picture.",
    "gives": "What the policy gets of this camera.",
    "strength": "How strongly the picture is occluded.",
    "x": "Centre of the patch, from the left; 0.5 is the middle.",
    "y": "Centre of the patch, from the top; 0.5 is the middle.",
    "width": "Width of the patch, as a share of the picture's; 1 is all of it.",
    "height": "Height of the patch, as a share of the picture's; 1 is all of it.",
    "close": "The camera stays as it is.",
}


class BreakPanel(WidgetPanel):
    """See the module. It has a ``MovePanel``, which is brought up to date with it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Send,
        frame: Frame,
        scene: viser.SceneApi | None = None,
    ) -> None:
        """``scene`` as in ``MovePanel``."""
        self._send = send
        self._frame = frame
        self.camera = ""
        """The camera that it is open for; '' while it is closed."""
        self._sliders: dict[str, SyncedInput] = {}
        self._folder = gui.add_folder("", visible=False)
        simulated = not frame.world.env.recorded  # Recordings are in colour, and from one place.
        with self._folder:
            self._style = gui.add_html("")
            buttons = {kind: row.button for kind, row in KINDS.items()}
            self._sends = Choice(gui, "Sends", buttons, self._break, HINTS["sends"])
            self._gives = Choice(gui, "Gives", GIVES, self._give, HINTS["gives"])
            self._gives.handle.visible = simulated
            close = gui.add_button("close", color="gray", hint=HINTS["close"])
            on_use(close, lambda *_: self.show(self.turn(self.camera)))
            sliders = [self._add_slider(gui, field) for field in SLIDERS]
            cells = [Cell(self._sends.handle, 1, 4, "above"), Cell(self._gives.handle, 1, 3)]
            cells += [Cell(close, 4), *(Cell(one, 1 + 2 * (i % 2), 2) for i, one in sliders)]
            place(gui, "breaks", 4, cells)
            with gui.add_folder("Where it stands", visible=simulated):  # A container has one grid.
                self.move = MovePanel(gui, send, frame, scene if simulated else None)
        self.move.again = lambda: self.again()  # It is brought up to date with this panel.
        self.handles = [self._folder]

    def _add_slider(self, gui: viser.GuiApi, field: str) -> tuple[int, viser.GuiSliderHandle]:
        """One fraction of an occlusion, with its place among ``SLIDERS``; the strength has no
        neighbour."""
        value = getattr(Occlusion(), field)
        hint = HINTS[field]
        slider = gui.add_slider(field, 0.0, 1.0, 0.01, value, marks=(), visible=False, hint=hint)
        on_use(slider, lambda _, value: self._drag(field, value))
        self._sliders[field] = SyncedInput(slider)
        return (len(self._sliders) + 1) % 2, slider

    def turn(self, camera: str) -> list[Assign]:
        """The changes that open it for ``camera``, or close it where it is open for that."""
        self.camera = "" if camera == self.camera else camera
        self.release()
        if self.camera:
            self.move.choose(self.camera)
        return self.update(self._frame)

    def release(self) -> None:
        """Follows the camera again, whatever a slider was dragged to."""
        for slider in self._sliders.values():
            slider.release()

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        camera = self.camera  # Read once: a click in another thread may change it meanwhile.
        changes = [Assign(self._folder, "visible", bool(camera)), *self.move.update(frame)]
        if not camera:
            return changes
        state = frame.camera(camera)
        verb = "Break" if frame.world.env.recorded else "Break or move"
        label = f"{verb} {frame.world.env.camera(camera).label}"
        style = self._sends.style(state.occlusion.kind) + self._gives.style(state.input)
        changes += [
            Assign(self._folder, "label", label),
            Assign(self._style, "content", f"<style>{style}</style>"),
        ]
        for field, slider in self._sliders.items():
            used = field in KINDS[state.occlusion.kind].uses
            changes.append(Assign(slider.handle, "visible", used))
            changes += slider.show(getattr(state.occlusion, field))
        return changes

    @property
    def _state(self) -> CameraState:
        return self._frame.camera(self.camera)

    def _ask(self, state: CameraState) -> None:
        if self.camera:
            self._send(SetCamera(self.camera, state))

    def _break(self, _: viser.ClientHandle, kind: str) -> None:
        """A camera that is off comes back with it, or nothing of it would be seen."""
        state = self._state
        given = untouched(self._frame.world.policy).input if state.input == "off" else state.input
        occlusion = replace(state.occlusion, kind=kind)  # type: ignore[arg-type]
        self._ask(CameraState(given, occlusion))

    def _give(self, _: viser.ClientHandle, value: str) -> None:
        self._ask(replace(self._state, input=value))  # type: ignore[arg-type]

    def _drag(self, field: str, value: float) -> None:
        occlusion = replace(self._state.occlusion, **{field: value})
        self._sliders[field].hold(value)
        self._ask(replace(self._state, occlusion=occlusion))

    def remove(self) -> None:
        self.move.remove()
        super().remove()
