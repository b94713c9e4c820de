"""The pictures of all cameras, and the switches that take them away."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from html import escape
from typing import Any

import viser

from madviz.app.panel import Assign, Send
from madviz.app.panels.breaks import BreakPanel
from madviz.app.panels.patch import HINT, attributes, field_style, parse_box, patched
from madviz.app.panels.policy import policy_words, verdict
from madviz.app.screen import Screen
from madviz.app.toolkit import Cell, Choice, WidgetPanel, on_use, place
from madviz.drawing.mosaic import GAP, Dropped, mosaic
from madviz.observation.displacement import MoveCamera
from madviz.session.camera_names import MODALITY_WORDS
from madviz.session.commands import Compare, Link, SetCamera
from madviz.session.frame import Frame, untouched
from madviz.subsets import modality_of

SWITCH = {"on": "on", "off": "off", "break": "break …"}
DROPPED = {"imagined": "what is imagined", "both": "truth beside it", "truth": "the truth"}
"""The choices for a dropped camera's tile, where the policy draws it."""
HINTS = {
    "switch": "Off drops it: the policy acts without it. Break: it stays in the sum, but sends a "
    "bad picture or stands elsewhere. On: all of it as in training.",
    "link": "Both sides lose the same cameras, or only A does.",
    "dropped": "It draws what a dropped camera would see, from the others. dB: how near that "
    "is to the truth, over the pixels that move; 20 dB is an error of a tenth.",
    "end": "Back to one policy. Its cameras stay as they are.",
}


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
    """The mosaic with a switch under every tile; B's mosaic below A's where there is a B, and what
    the switches act on. ``send`` None: read-only."""

    def __init__(
        self, gui: viser.GuiApi, send: Send | None, frame: Frame, width: int, paired: int = 150
    ) -> None:
        """``width`` in pixels of the picture; tiles share it. ``paired``: pixels of a tile where
        there are two mosaics."""
        self._names = [camera.name for camera in frame.world.env.cameras]
        self._style = gui.add_html("")
        self._frame = frame
        self._send = send
        self.breaks: BreakPanel | None = None
        """The panel that *break* opens for a camera."""
        self._switches: list[Choice] = []
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
        self._link: Choice | None = None
        self._linking: list[Any] = []
        """Shown while A and B are compared: ``_link``, and the way back to one policy."""
        if send is not None:
            self._link = Choice(
                gui,
                "Switches act on",
                {"both": "A and B", "a": "A only"},
                lambda _, value: send(Link(value == "both")),
                HINTS["link"],
            )
            end = gui.add_button("end comparison", color="gray", hint=HINTS["end"])
            on_use(end, lambda *_: send(Compare(None)))
            self._linking = [self._link.handle, end]
            for handle in self._linking:
                handle.visible = False
            for camera in frame.world.env.cameras:
                press = partial(self._switch, camera.name)
                self._switches.append(Choice(gui, camera.label, SWITCH, press, HINTS["switch"]))
        if self._field is not None:
            on_use(self._field, lambda _, text: self._draw(text))
        screens = [one.screen for one in self._mosaics]
        self._note = gui.add_html("")
        grid = place(gui, "cameras", len(self._names), self._cells())
        self.handles = [self._style, *self._titles, *screens, *grid, self._note]

    def _switch(self, name: str, _: viser.ClientHandle, value: str) -> None:
        assert self._send is not None
        state = self._frame.camera(name)
        if value == "off":
            self._send(SetCamera(name, replace(state, input="off")))
        elif value == "on":
            self._send(SetCamera(name, untouched(self._frame.world.policy)))
            if name in self._frame.world.ablation.moves:
                self._send(MoveCamera(name, None))
        elif self.breaks is not None:
            self.show([*self.breaks.turn(name), self._marks(self._frame)])

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
        self.show([*self._pictures(self._frame), self._marks(self._frame)])

    def _marks(self, frame: Frame) -> Assign:
        """CSS that marks the active buttons and hides the field."""
        opened = self.breaks.camera if self.breaks else ""
        marks = "".join(
            switch.style(switched(frame, name), opened="break" if name == opened else "")
            for name, switch in zip(self._names, self._switches, strict=False)
        )
        marks += self._drop.style(self._dropped)
        marks += field_style(self._field) if self._field else ""
        if self._link is not None:
            marks += self._link.style("both" if frame.linked else "a")
        return Assign(self._style, "content", f"<style>{marks}</style>")

    def _draw(self, text: str) -> None:
        assert self._send is not None
        box = parse_box(text, len(self._names))
        name = self._names[box.tile]
        state = patched(self._frame.camera(name), box, self._mosaics[0].tile)
        if self.breaks is not None:
            self.breaks.release()
        self._send(SetCamera(name, state))

    def _cells(self) -> list[Cell]:
        cells = [Cell(self._field, 1)] if self._field else []
        count = len(self._names)
        if self._linking:
            cells.append(Cell(self._linking[0], 1, max(count - 1, 1), "8em"))
            cells.append(Cell(self._linking[1], count))
        cells.append(Cell(self._drop.handle, 1, max(count, 1), "11em"))
        for index, switch in enumerate(self._switches):
            cells.append(Cell(switch.handle, index + 1, label="none"))
        return cells

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        paired = frame.second is not None
        changes = [Assign(self._mosaics[1].screen.handle, "visible", paired)]
        changes += [Assign(title, "visible", paired) for title in self._titles]
        # The choice is there where a policy draws what a dropped camera would see.
        drawn = bool(frame.world.imagined or (frame.second and frame.second.world.imagined))
        changes += [*self._pictures(frame), Assign(self._drop.handle, "visible", drawn)]
        changes += [Assign(handle, "visible", paired) for handle in self._linking]
        changes.append(self._marks(frame))
        hinted = self._field is not None and not paired
        hint = f'<div class="mv"><span class="dim">{HINT}</span></div>' if hinted else ""
        changes.append(Assign(self._note, "content", unused_note(frame) or hint))
        return changes


def switched(frame: Frame, name: str) -> str:
    """The button of ``SWITCH`` that says how a camera is."""
    state = frame.camera(name)
    if state.input == "off":
        return "off"
    whole = state == untouched(frame.world.policy) and name not in frame.world.ablation.moves
    return "on" if whole else "break"


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
