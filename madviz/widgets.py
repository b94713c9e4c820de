"""Widgets for notebooks: a policy to play with, functions with sliders, questions before answers.

    from madviz.widgets import Explorer
    Explorer("metaworld-hammer-mad-light")

The problem: a notebook's kernel has one thread for cells and clicks, a simulator and its OpenGL
context have one of their own, and a picture that is displayed anew makes the page jump. The idea:
the session's thread owns the simulation, as on the live page; a second thread takes its newest
frame, draws it, and puts the JPEG into one image that stays where it is:

    cell, clicks -- commands --> session's thread -- frame --> painter -- JPEG --> one Image
                                 (simulates)         (newest)  (draws)

A picture of three cameras is 20 to 30 kB, so 20 a second are half a megabyte a second. Clicks wait
while a cell runs, because the kernel hears them in between cells; the pictures do not.

Every widget shows its present state also where a notebook is only displayed, and has no kernel.
"""

from __future__ import annotations

import threading
import time
from base64 import b64encode
from collections.abc import Callable, Sequence
from html import escape
from typing import Any, ClassVar

import ipywidgets
import numpy as np

from madviz import checkpoint
from madviz.ablations import CameraInput, CameraState, Occlusion, OcclusionKind
from madviz.app.mosaic import mosaic
from madviz.envs.base import make_env
from madviz.session.commands import Command, Pause, Play, Reset, SetCamera, SetSpeed, StepOnce
from madviz.session.frame import Failure, Frame, words
from madviz.session.session import EnvFactory, Session
from madviz.subsets import modality_of, name_of
from madviz.teaching import begin
from madviz.teaching_show import Draws, Words, jpeg
from madviz.types import Array, CameraSpec, Environment, Policy, UserError
from madviz.widgets_page import LivePage, Viewer, live_page

__all__ = ["Explorer", "LivePage", "Predict", "TryOut", "Viewer", "live_page"]

INPUTS: dict[str, CameraInput] = {"colour": "rgb", "depth": "depth", "both": "both", "off": "off"}
OCCLUSIONS: dict[str, OcclusionKind] = {
    **{"sees": "none", "sends black": "black", "sends noise": "noise", "is frozen": "freeze"},
    **{"is blurred": "blur", "has a patch": "patch", "loses pictures": "dropout"},
    "is late": "delay",
}
PICTURE = {"max_width": "100%", "align_self": "flex-start"}
SPEEDS = {"3 a second": 3.0, "10 a second": 10.0, "20 a second": 20.0, "as fast as it goes": 0.0}
"""Decisions; 0 for no limit (a menu shows nothing for None)."""
PICTURES = 20.0
"""Pictures a second at most; a browser draws no more than it is sent."""
PATIENCE = 120.0
"""Seconds to wait for a simulator to open on a busy machine."""
ROWS = 12
"""Rows of the table of subsets; with six streams there would be 64."""

ALIVE = 3
"""Explorers of one kernel at once, some 200 MB each. A cell that is run again adds one, whatever
becomes of the name it had, so one too many ends the oldest."""
ENDED = "<p>This simulation has ended; run the cell again for a new one.</p>"


class Shown(ipywidgets.VBox):
    """A box that also says what it shows where there are no widgets."""

    def still(self) -> str:
        """HTML for a page without a kernel."""
        return ""

    def _repr_mimebundle_(self, **kwargs: Any) -> Any:
        bundle = super()._repr_mimebundle_(**kwargs)
        if isinstance(bundle, dict):
            bundle["text/html"] = self.still()
        return bundle


class Explorer(Shown):
    """A policy at work, and switches for its cameras. ``close`` ends its simulation, and so does
    the ``ALIVE``-th explorer after it."""

    _alive: ClassVar[list[Explorer]] = []

    def __init__(
        self,
        policy: str | Policy,
        *,
        seed: int = 2000,
        playing: bool = False,
        tile: int = 224,
        env_factory: EnvFactory | None = None,
    ) -> None:
        """``tile`` is the width of a camera's picture in pixels. Raises UserError for a policy that
        cannot be found and for a machine that cannot draw."""
        self._painter: threading.Thread | None = None
        begin()
        loaded = checkpoint.load_policy(policy) if isinstance(policy, str) else policy
        self.session = Session(env_factory or open_env, loaded, seed=seed)
        self.painted, self._tile = 0, tile
        self._ready, self._closing = threading.Event(), threading.Event()
        if not playing:
            self.session.send(Pause())
        self.session.subscribe(lambda frame: self._ready.set())
        self.session.start()
        try:
            first = self._first(playing)
        except UserError:
            self.session.close()
            raise
        self._picture = ipywidgets.Image(format="jpeg", layout=PICTURE)
        self._words, self._table = ipywidgets.HTML(), ipywidgets.HTML()
        self._play = ipywidgets.Button(button_style="info", layout={"width": "90px"})
        self._play.on_click(lambda _: self._toggle())
        self._rows = {c.name: self._camera_row(first, c) for c in first.env.cameras}
        self._bar = self._buttons()
        super().__init__([self._bar, self._picture, *self._rows.values(), self._words])
        self.children = (*self.children, self._table)
        self.paint(first)
        self._painter = threading.Thread(target=self._run, name="madviz-painter", daemon=True)
        self._painter.start()
        self._alive.append(self)
        if len(self._alive) > ALIVE:
            self._alive[0].close()

    # What a cell can do.

    @property
    def frame(self) -> Frame:
        """The newest instant. Raises UserError with the session's own words if there is none."""
        latest = self.session.latest
        if not isinstance(latest, Frame):
            found = latest.error if isinstance(latest, Failure) else "nothing yet"
            raise UserError(f"expected a running episode, found: {found.splitlines()[0]}")
        return latest

    def set(
        self, camera: str, input: CameraInput = "rgb", occlusion: OcclusionKind = "none"
    ) -> None:
        """The same as a click: another switch or occlusion for ``camera``."""
        self.frame.env.camera(camera)
        state = CameraState(input, Occlusion(occlusion))
        self._obeyed(SetCamera(camera, state), lambda frame: frame.camera(camera) == state)

    def step(self, count: int = 1) -> None:
        """Takes decisions, then pauses."""
        for _ in range(count):
            before = (self.frame.episode, self.frame.step)
            self._obeyed(
                StepOnce(),
                lambda frame, before=before: (
                    (frame.episode, frame.step) != before and frame.phase != "playing"
                ),
            )

    def close(self) -> None:
        """Ends the simulation; the last picture stays, and says so."""
        if self._painter is None:
            return  # ipywidgets closes what it forgets, and this one was never finished.
        if self in self._alive:
            self._alive.remove(self)
        self._closing.set()
        self._ready.set()
        self.session.close()
        self._painter.join(PATIENCE)
        for row in (self._bar, *self._rows.values()):
            for control in row.children:
                if hasattr(control, "disabled"):
                    control.disabled = True
        self._words.value = f"{self._words.value.removesuffix(ENDED)}{ENDED}"

    def still(self) -> str:
        picture = b64encode(self._picture.value).decode()
        return (
            f'<img alt="what each camera sends" src="data:image/jpeg;base64,{picture}">'
            f"{self._words.value}{self._table.value}"
        )

    # Drawing.

    def paint(self, frame: Frame) -> None:
        """Puts ``frame`` into the widgets that show it."""
        self._picture.value = jpeg(mosaic(frame, self._tile))
        self._words.value = words_html(frame)
        self._table.value = table_html(frame)
        self._play.description = "Play" if frame.phase == "paused" else "Pause"
        self.painted += 1

    def _run(self) -> None:
        while True:
            self._ready.wait()
            self._ready.clear()
            if self._closing.is_set():
                return
            began = time.monotonic()
            latest = self.session.latest
            if isinstance(latest, Frame):
                self.paint(latest)
            elif isinstance(latest, Failure):
                self._words.value = f"<pre>{escape(latest.error)}</pre>"
            self._closing.wait(max(0.0, 1 / PICTURES - (time.monotonic() - began)))

    def _first(self, playing: bool) -> Frame:
        """Waits for the episode to open; where it shall not play, until it has paused."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            latest = self.session.latest
            if isinstance(latest, Failure):
                break
            if latest is not None and (playing or latest.phase == "paused"):
                break
            self._ready.wait(0.05)
            self._ready.clear()
        return self.frame

    def _obeyed(self, command: Command, done: Callable[[Frame], bool]) -> None:
        """Sends a command and waits for a frame that shows it, or an error."""
        self.session.send(command)
        deadline = time.monotonic() + PATIENCE
        while not (done(self.frame) or self.frame.error) and time.monotonic() < deadline:
            time.sleep(0.005)

    # Controls.

    def _toggle(self) -> None:
        self.session.send(Play() if self.frame.phase == "paused" else Pause())

    def _buttons(self) -> ipywidgets.HBox:
        box: list[ipywidgets.Widget] = [self._play]
        for label, command in (
            ("One step", StepOnce()),
            ("Again", Reset()),
            ("Next episode", Reset(next_seed=True)),
        ):
            button = ipywidgets.Button(description=label, layout={"width": "110px"})
            button.on_click(lambda _, command=command: self.session.send(command))
            box.append(button)
        speed = ipywidgets.Dropdown(options=SPEEDS, value=10.0, layout={"width": "150px"})
        speed.observe(lambda change: self.session.send(SetSpeed(change["new"] or None)), "value")
        return ipywidgets.HBox([*box, speed])

    def _camera_row(self, frame: Frame, camera: CameraSpec) -> ipywidgets.HBox:
        known = {modality_of(stream) for stream in frame.policy.streams}
        unknown = {"rgb", "depth", "both"} - known if len(known) < 2 else set()
        inputs = {label: value for label, value in INPUTS.items() if value not in unknown}
        switch: Any = ipywidgets.ToggleButtons(
            options=inputs, value=frame.camera(camera.name).input, style={"button_width": "70px"}
        )
        fails: Any = ipywidgets.Dropdown(
            options=OCCLUSIONS, value="none", layout={"width": "140px"}
        )

        def send(_: Any) -> None:
            state = CameraState(switch.value, Occlusion(fails.value))
            self.session.send(SetCamera(camera.name, state))

        switch.observe(send, "value")
        fails.observe(send, "value")
        label = ipywidgets.Label(camera.label, layout={"width": "100px"})
        return ipywidgets.HBox([label, switch, fails])


def open_env(task: str, render_profile: str, cameras: tuple[CameraSpec, ...] = ()) -> Environment:
    """``make_env`` in the session's thread, which computes on one core (see ``teaching.begin``)."""
    begin()
    return make_env(task, render_profile, cameras)


def words_html(frame: Frame) -> str:
    """Where the episode stands, and what came of the last click."""
    fate = "success" if frame.success else "not yet" if not frame.ended else "failed"
    lines = [
        f"seed {frame.seed}, decision {frame.step} of {frame.env.horizon}: <b>{fate}</b>",
        escape(words(frame.change, frame.env)) if frame.change else "",
        escape(frame.error.splitlines()[0]) if frame.error else "",
    ]
    return "<br>".join(line for line in lines if line)


def table_html(frame: Frame) -> str:
    """The present subset, the trained ones and others: action, how far it is from now's, Q."""
    probe, streams = frame.probe, frame.policy.streams
    head = "".join(f"<th>{w}</th>" for w in ("cameras", "", "action", "differs by", "Q"))
    rows = [
        _subset_row(frame, row, name_of(probe.masks[row], streams)) for row in shown_rows(frame)
    ]
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def shown_rows(frame: Frame) -> list[int]:
    """At most ROWS rows of the probe: the present subset, then the trained ones, then the rest."""
    trained = set(frame.policy.trained_subsets)
    names = [name_of(mask, frame.policy.streams) for mask in frame.probe.masks]
    order = sorted(range(len(names)), key=lambda r: (r != frame.row, names[r] not in trained, r))
    return order[:ROWS]


def _subset_row(frame: Frame, row: int, name: str) -> str:
    readout, note = frame.probe.readout, []
    if row == frame.row:
        note.append("now")
    if name not in frame.policy.trained_subsets:
        note.append("off-training")
    action: Array = readout.action[row]
    if not np.isfinite(action).all():
        cells = ["cannot act on this", "", ""]
    else:
        apart = float(np.linalg.norm(action - frame.action))
        cells = [" ".join(f"{a:+.2f}" for a in action), f"{apart:.2f}", f"{readout.q[row]:.1f}"]
    return "".join(
        ("<tr>", *(f"<td>{escape(c)}</td>" for c in (name, ", ".join(note), *cells)), "</tr>")
    )


class TryOut(Shown):
    """A function that draws, and a control for each of its arguments.

    ``TryOut(draw, n=(5, 200), rate=(0.0, 1.0, 0.05), camera=["first", "third_a"], squared=True)``:
    a pair or triple becomes a slider, a list a menu, True or False a tick.
    """

    def __init__(self, draw: Draws, **choices: Any) -> None:
        """``draw`` returns something of ``madviz.teaching_show``."""
        self.controls = {name: control_for(value) for name, value in choices.items()}
        self._draw, self._drawn = draw, ipywidgets.HTML()
        for name, control in self.controls.items():
            control.description = name.replace("_", " ")
            control.style.description_width = "110px"
            control.layout.width = "420px"
            control.observe(lambda _: self._show(), "value")
        super().__init__([*self.controls.values(), self._drawn])
        self._show()

    def _show(self) -> None:
        values = {name: control.value for name, control in self.controls.items()}
        self._drawn.value = self._draw(**values).html

    def still(self) -> str:
        values = (f"{name} = {control.value}" for name, control in self.controls.items())
        return f"<p>{escape(', '.join(values))}</p>{self._drawn.value}"


def control_for(choice: Any) -> Any:
    """The control for an argument: a tick for a truth, a menu for a list, a slider for (lowest,
    highest) or (lowest, highest, step). Raises UserError for anything else."""
    if isinstance(choice, bool):
        return ipywidgets.Checkbox(choice)
    if isinstance(choice, list) and choice:
        return ipywidgets.Dropdown(options=choice)
    if isinstance(choice, tuple) and len(choice) in (2, 3):
        whole = all(isinstance(number, int) for number in choice)
        low, high, *steps = choice
        step = steps[0] if steps else 1 if whole else (high - low) / 100
        if whole:
            return ipywidgets.IntSlider((low + high) // 2, low, high, step)
        return ipywidgets.FloatSlider((low + high) / 2, min=low, max=high, step=step)
    raise UserError(f"expected True, False, a list or (lowest, highest), found {choice!r}")


class Predict(Shown):
    """A question to answer before the next cell is run; nobody is told a grade."""

    def __init__(self, question: str, options: Sequence[str]) -> None:
        self._options = tuple(options)
        self.choice = ipywidgets.RadioButtons(
            options=self._options, value=None, layout={"width": "max-content"}
        )
        self._question = ipywidgets.HTML(f"<b>Predict first.</b> {escape(question)}")
        super().__init__([self._question, self.choice])

    @property
    def said(self) -> str | None:
        return self.choice.value

    def still(self) -> str:
        items = "".join(f"<li>{escape(option)}</li>" for option in self._options)
        return f"{self._question.value}<ul>{items}</ul>"

    def compare(self, measured: str) -> Words:
        """The prediction beside what was measured."""
        return Words(f"You predicted: {self.said or 'nothing yet'}. Measured: {measured}.")
