"""The pictures of all cameras, and the switches that take them away."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from html import escape

import viser

from madviz.app.panel import Assign, apply
from madviz.app.panels.patch import HINT, Box, attributes, field_style, parse_box, patched
from madviz.app.panels.policy import policy_words, verdict
from madviz.app.panels.subsets import MODALITY_WORDS
from madviz.app.screen import Screen
from madviz.app.toolkit import Cell, Choice, SyncedInput, WidgetPanel, on_press, on_value, place
from madviz.drawing.mosaic import GAP, Dropped, mosaic
from madviz.observation.ablation import KINDS, PLACE, CameraState, Occlusion
from madviz.session.commands import Compare, Link, SetCamera
from madviz.session.frame import Frame, untouched
from madviz.subsets import modality_of
from madviz.types import CameraSpec

INPUTS = {"rgb": "RGB", "depth": "depth", "both": "both", "off": "off"}
DROPPED = {"imagined": "what is imagined", "both": "truth beside it", "truth": "the truth"}
"""The choices for a dropped camera's tile, where the policy draws it."""
SLIDERS = ("strength", *PLACE)
"""The fractions of an occlusion; each has a slider, which shows where its kind uses it."""
HINTS = {
    "input": "What the policy gets of this camera. Off drops it: the policy acts without it.",
    "occlusion": "A failing camera: it stays in the sum, but sends a broken picture.",
    "strength": "How strongly the picture is occluded.",
    "x": "Centre of the patch, from the left; 0.5 is the middle.",
    "y": "Centre of the patch, from the top; 0.5 is the middle.",
    "width": "Width of the patch, as a share of the picture's; 1 is all of it.",
    "link": "Both sides lose the same cameras, or only A does.",
    "dropped": "It draws what a dropped camera would see, from the others. dB: how near that "
    "is to the truth, over the pixels that move; 20 dB is an error of a tenth.",
    "end": "Back to one policy. Its cameras stay as they are.",
    "height": "Height of the patch, as a share of the picture's; 1 is all of it.",
}


class CameraControls:
    """The switches of one camera. ``send`` gets what a visitor asks for."""

    def __init__(self, gui: viser.GuiApi, send: Callable[[SetCamera], None], name: str) -> None:
        self.name = name
        self._send = send
        self._state = CameraState()
        self.input: Choice
        self.occlusion: Choice
        self.sliders: dict[str, SyncedInput] = {}
        self._gui = gui

    def add_input(self) -> None:
        """Buttons: what the policy gets of this camera."""
        self.input = Choice(self._gui, "Input", INPUTS, self._on_input, HINTS["input"])

    def add_occlusion(self) -> None:
        """Buttons: how the camera fails."""
        buttons = {kind: row.button for kind, row in KINDS.items()}
        self.occlusion = Choice(
            self._gui, "Occlude", buttons, self._on_occlusion, HINTS["occlusion"]
        )

    def add_slider(self, field: str) -> None:
        """One fraction of an occlusion; see ``SLIDERS``."""
        handle = self._gui.add_slider(
            field,
            0.0,
            1.0,
            0.01,
            getattr(Occlusion(), field),
            marks=(),
            visible=False,
            hint=HINTS[field],
        )
        on_value(handle, lambda _, value: self._on_fraction(field, value))
        self.sliders[field] = SyncedInput(handle)

    def style(self) -> str:
        """CSS that marks the active buttons."""
        return self.input.style(self._state.input) + self.occlusion.style(
            self._state.occlusion.kind
        )

    def show(self, state: CameraState) -> list[Assign]:
        """The changes that show ``state``; a slider that is being dragged stays."""
        self._state = state
        changes = []
        for field, slider in self.sliders.items():
            used = field in KINDS[state.occlusion.kind].uses
            changes.append(Assign(slider.handle, "visible", used))
            changes += slider.show(getattr(state.occlusion, field))
        return changes

    def cover(self, box: Box, tile: int) -> None:
        """A patch where a visitor has drawn a box on a tile of ``tile`` pixels."""
        for slider in self.sliders.values():
            slider.release()
        self._ask(patched(self._state, box, tile))

    def _ask(self, state: CameraState) -> None:
        self._state = state
        self._send(SetCamera(self.name, state))

    def _on_input(self, _: viser.ClientHandle, value: str) -> None:
        self._ask(replace(self._state, input=value))  # type: ignore[arg-type]

    def _on_occlusion(self, _: viser.ClientHandle, value: str) -> None:
        occlusion = replace(self._state.occlusion, kind=value)  # type: ignore[arg-type]
        self._ask(replace(self._state, occlusion=occlusion))

    def _on_fraction(self, field: str, value: float) -> None:
        occlusion = replace(self._state.occlusion, **{field: value})
        self.sliders[field].hold(value)
        self._ask(replace(self._state, occlusion=occlusion))


class Mosaic:
    """All cameras of one side in one picture. Above or below another one, it is smaller."""

    def __init__(
        self,
        gui: viser.GuiApi,
        frame: Frame,
        width: int,
        most: int,
        alt: str,
        field: viser.GuiTextHandle | None,
    ) -> None:
        """``width`` in pixels of the picture; tiles share it. ``most``: of a tile where there are
        two mosaics. ``field`` takes what is drawn on the picture (``patch``)."""
        self._count = len(frame.world.env.cameras)
        self._field = field
        self._column = (width - (self._count - 1) * GAP) // self._count
        self._most = min(self._column, most)
        self.paired = False
        picture = mosaic(frame, self.tile, self._column)
        self.screen = Screen(gui, picture, step_of(frame), alt, self._attributes())

    @property
    def tile(self) -> int:
        """Pixels that a camera's picture is wide and high."""
        return self._most if self.paired else self._column

    def _attributes(self) -> str:
        return attributes(self._field, self._count, self.tile, self._column) if self._field else ""

    def show(self, frame: Frame, paired: bool, dropped: Dropped) -> Assign:
        """The next picture; ``paired``: one of two."""
        changed = paired != self.paired
        self.paired = paired
        picture = mosaic(frame, self.tile, self._column, dropped)
        step = step_of(frame)
        if changed:
            return self.screen.fit(picture, step, self._attributes())
        return self.screen.show(picture, step)


class CamerasPanel(WidgetPanel):
    """The mosaic with a column of controls under every tile; B's mosaic below A's where there is a
    B, and what the controls act on. ``send`` None: read-only."""

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Callable[[SetCamera | Link | Compare], None] | None,
        frame: Frame,
        width: int,
        paired: int = 150,
    ) -> None:
        """``width`` in pixels of the picture; tiles share it. ``paired``: pixels of a tile where
        there are two mosaics."""
        count = len(frame.world.env.cameras)
        self._style = gui.add_html("")
        self._frame = frame
        self._controls: list[CameraControls] = []
        self._field = gui.add_text("box", "") if send is not None else None
        self._titles = []
        self._mosaics = []
        for name in ("A", "B"):
            self._titles.append(gui.add_html("", visible=False))
            alt = f"what every camera sends{', B' if name == 'B' else ''}"
            field = self._field if name == "A" else None
            self._mosaics.append(Mosaic(gui, frame, width, paired, alt, field))
        self._mosaics[1].screen.handle.visible = False
        self._dropped: Dropped = "imagined"
        self._drop = Choice(
            gui, "Dropped cameras show", DROPPED, self._choose_dropped, HINTS["dropped"]
        )
        self._drop.handle.visible = False
        self._link = LinkControls(gui, send) if send is not None else None
        if send is not None:
            self._build(gui, send, frame.world.env.cameras)
        if self._field is not None:
            on_value(self._field, lambda _, text: self._draw(text))
        screens = [one.screen for one in self._mosaics]
        self._note = gui.add_html("")
        grid = place(gui, "cameras", count, self._cells())
        self.handles = [self._style, *self._titles, *screens, *grid, self._note]

    def _build(
        self,
        gui: viser.GuiApi,
        send: Callable[[SetCamera], None],
        cameras: tuple[CameraSpec, ...],
    ) -> None:
        """Row by row, so that the grid fills in this order."""
        self._controls = [CameraControls(gui, send, camera.name) for camera in cameras]
        for control in self._controls:
            control.add_input()
        for control in self._controls:
            control.add_occlusion()
        for field in SLIDERS:
            for control in self._controls:
                control.add_slider(field)

    def _pictures(self, frame: Frame) -> list[Assign]:
        changes = []
        paired = frame.second is not None
        for index, side in enumerate((frame, frame.second)):
            if side is not None:
                changes.append(self._mosaics[index].show(side, paired, self._dropped))
                title = side_html("AB"[index], side) if paired else ""
                changes.append(Assign(self._titles[index], "content", title))
        return changes

    def _choose_dropped(self, _: viser.ClientHandle, value: str) -> None:
        self._dropped = value  # type: ignore[assignment]
        apply([*self._pictures(self._frame), self._marks(self._frame)])

    def _marks(self, frame: Frame) -> Assign:
        """CSS that marks the active buttons and hides the field."""
        marks = "".join(control.style() for control in self._controls)
        marks += self._drop.style(self._dropped)
        marks += field_style(self._field) if self._field else ""
        if self._link is not None:
            marks += self._link.choice.style("both" if frame.linked else "a")
        return Assign(self._style, "content", f"<style>{marks}</style>")

    def _draw(self, text: str) -> None:
        box = parse_box(text, len(self._controls))
        self._controls[box.tile].cover(box, self._mosaics[0].tile)

    def _cells(self) -> list[Cell]:
        cells = [Cell(self._field, 1)] if self._field else []
        count = len(self._controls)
        if self._link is not None:
            cells.append(Cell(self._link.choice.handle, 1, max(count - 1, 1), "11em"))
            cells.append(Cell(self._link.end, count))
        cells.append(Cell(self._drop.handle, 1, max(count, 1), "11em"))
        for index, control in enumerate(self._controls):
            cells.append(Cell(control.input.handle, index + 1, label="above"))
            cells.append(Cell(control.occlusion.handle, index + 1, label="above", button="15%"))
            cells += [Cell(slider.handle, index + 1) for slider in control.sliders.values()]
        return cells

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        paired = frame.second is not None
        changes = [Assign(self._mosaics[1].screen.handle, "visible", paired)]
        changes += [Assign(title, "visible", paired) for title in self._titles]
        # The choice is there where a policy draws what a dropped camera would see.
        drawn = bool(frame.world.imagined or (frame.second and frame.second.world.imagined))
        changes += [*self._pictures(frame), Assign(self._drop.handle, "visible", drawn)]
        for control in self._controls:
            changes += control.show(frame.camera(control.name))
        if self._link is not None:
            changes += self._link.show(paired)
        changes.append(self._marks(frame))
        hinted = self._field is not None and not paired
        hint = f'<div class="mv"><span class="dim">{HINT}</span></div>' if hinted else ""
        changes.append(Assign(self._note, "content", unused_note(frame) or hint))
        return changes


class LinkControls:
    """The choice of what the switches act on while A and B are compared, and the way back to one
    policy."""

    def __init__(self, gui: viser.GuiApi, send: Callable[[Link | Compare], None]) -> None:
        self.choice = Choice(
            gui,
            "Switches act on",
            {"both": "A and B", "a": "A only"},
            lambda _, value: send(Link(value == "both")),
            HINTS["link"],
        )
        self.end = gui.add_button("end comparison", color="gray", hint=HINTS["end"], visible=False)
        self.choice.handle.visible = False
        on_press(self.end, lambda: send(Compare(None)))

    def show(self, on: bool) -> list[Assign]:
        """Whether they are to be seen."""
        return [Assign(handle, "visible", on) for handle in (self.choice.handle, self.end)]


def side_html(name: str, frame: Frame) -> str:
    """Whose pictures these are, what kind of policy it is, and how its episode stands."""
    word, colour = verdict(frame)
    words = escape(policy_words(frame.world.policy))
    return (
        f'<div class="mv mv-side"><b>{name}</b><span class="words">{words}</span>'
        f'<span class="num">step <b>{frame.world.step}</b></span>'
        f'<span class="tag" style="background:{colour}">{word}</span></div>'
    )


def step_of(frame: Frame) -> str:
    """Which time step a picture shows; the status line says it too."""
    return f"{frame.world.episode}:{frame.world.step}"


NO_DROPPING = (
    "This policy needs a picture of every camera: none can be left out, and <b>off</b> stops it. "
    "Give it black, the mean picture or noise instead; it then sees something: not the same."
)


def unused_note(frame: Frame) -> str:
    """Says so where a visitor shows the policy something it does not take, or where no camera can
    be left out."""
    if not frame.world.policy.can_drop:
        return f'<div class="mv dim">{NO_DROPPING}</div>'
    known = {modality_of(stream) for stream in frame.world.policy.streams}
    asked = set()
    for camera in frame.world.env.cameras:
        switch = frame.camera(camera.name).input
        asked |= {"rgb", "depth"} if switch == "both" else {switch} - {"off"}
    missing = asked - known
    if not missing:
        return ""
    word = MODALITY_WORDS[missing.pop()]
    takes = MODALITY_WORDS[untouched(frame.world.policy).input]
    return (
        f'<div class="mv dim">This policy takes {takes} only: {word} is shown, but does not reach '
        "it. A camera that gives only that counts as dropped.</div>"
    )
