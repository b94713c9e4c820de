"""A policy to play with in a notebook: pictures, switches, and what every set of cameras would do.

    from madviz.widgets import Explorer
    Explorer("metaworld-hammer-mad-light")

The problem: a notebook's kernel has one thread for cells and clicks, a simulator and its OpenGL
context have one of their own, and a picture that is displayed anew makes the page jump. The idea:
the session's thread owns the simulation, as on the live page; a second thread takes its newest
frame, draws it, and puts the JPEG into one image that stays where it is:

    cell, clicks -- commands --> session's thread -- frame --> painter -- JPEG --> one Image
                                 (simulates)         (newest)  (draws)

A picture of three cameras is 20 to 30 kB, so 20 a second are half a megabyte a second. Clicks wait
while a cell runs, because the kernel reads them between cells; the pictures do not.
"""

from __future__ import annotations

import threading
import time
from base64 import b64encode
from collections.abc import Callable
from dataclasses import replace
from html import escape
from typing import Any, ClassVar, cast

import ipywidgets

from madviz.drawing.jpeg import jpeg
from madviz.drawing.mosaic import mosaic
from madviz.envs.registry import make_env
from madviz.errors import UserError, parts_of
from madviz.observation.ablation import KINDS, CameraInput, CameraState, Occlusion, OcclusionKind
from madviz.policies import checkpoint
from madviz.session.commands import Command, Pause, Play, Reset, SetCamera, SetSpeed, StepOnce
from madviz.session.comparison import EnvFactory
from madviz.session.frame import Frame, NoFrame, untouched
from madviz.session.session import Session
from madviz.subsets import modality_of
from madviz.teaching import begin
from madviz.types import CameraSpec, Environment, Policy
from madviz.widgets.explorer_table import table_html, words_html
from madviz.widgets.static import StaticBox

INPUTS: dict[str, CameraInput] = {"colour": "rgb", "depth": "depth", "both": "both", "off": "off"}
PICTURE = {"max_width": "100%", "align_self": "flex-start"}
SPEEDS = {"3 a second": 3.0, "10 a second": 10.0, "20 a second": 20.0, "as fast as it goes": 0.0}
"""Decisions; 0 for no limit (a menu shows nothing for None)."""
PICTURES = 20.0
"""Pictures a second at most; a browser draws no more than it is sent."""
PATIENCE = 120.0
"""Seconds to wait for a simulator to open on a busy machine."""

MOST = 3
"""Explorers of one kernel at once, some 200 MB each. A cell that is run again adds one, so one too
many ends the oldest."""
ENDED = "<p>This simulation has ended; run the cell again for a new one.</p>"


class Explorer(StaticBox):
    """A policy at work, and switches for its cameras. ``close`` ends its simulation, and so does
    the ``MOST``-th explorer after it."""

    running: ClassVar[list[Explorer]] = []
    """Those that were not closed, the oldest first."""

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
        self.painted = 0
        self._tile = tile
        self._ready = threading.Event()
        self._closing = threading.Event()
        if not playing:
            self.session.send(Pause())
        self.session.subscribe(lambda frame: self._ready.set())
        self.session.start()
        try:
            first = self._first(playing)
        except UserError:
            self.session.close()
            raise
        self.picture = ipywidgets.Image(format="jpeg", layout=PICTURE)
        self.words = ipywidgets.HTML()
        self.table = ipywidgets.HTML()
        self.play = ipywidgets.Button(button_style="info", layout={"width": "90px"})
        self.play.on_click(lambda _: self._toggle())
        self._states = {c.name: first.camera(c.name) for c in first.world.env.cameras}
        """The state of every camera, as it was asked for or shown last."""
        self._followed = dict(self._states)
        """The state of every camera, as the newest frame had it: switches follow what changes, for
        an older frame would take back what was just chosen."""
        self._following: int | None = None
        """The thread that assigns to switches now, which is nobody's click."""
        self.switches = {c.name: self._camera_row(first, c) for c in first.world.env.cameras}
        self._bar = self._buttons()
        super().__init__([self._bar, self.picture, *self.switches.values(), self.words])
        self.children = (*self.children, self.table)
        self.paint(first)
        self._painter = threading.Thread(target=self._run, name="madviz-painter", daemon=True)
        self._painter.start()
        self.running.append(self)
        if len(self.running) > MOST:
            self.running[0].close()

    # What a cell can do.

    @property
    def frame(self) -> Frame:
        """The newest time step. Raises UserError with the session's own words if there is none."""
        latest = self.session.latest
        if not isinstance(latest, Frame):
            raise UserError(f"expected a running episode, found: {_words(latest)}")
        return latest

    def set(
        self, camera: str, input: CameraInput | None = None, occlusion: OcclusionKind = "none"
    ) -> None:
        """The same as a click: another switch or occlusion for ``camera``. ``input`` None: all that
        the policy knows of it, colour, depth or both."""
        self.frame.world.env.camera(camera)
        state = CameraState(input or untouched(self.frame.world.policy).input, Occlusion(occlusion))
        self._send_and_wait(SetCamera(camera, state), lambda frame: frame.camera(camera) == state)

    def step(self, count: int = 1) -> None:
        """Takes decisions, then pauses."""
        for _ in range(count):
            before = (self.frame.world.episode, self.frame.world.step)
            self._send_and_wait(
                StepOnce(),
                lambda frame, before=before: (
                    (frame.world.episode, frame.world.step) != before
                    and frame.pace.phase != "playing"
                ),
            )

    def close(self) -> None:
        """Ends the simulation; the last picture stays, and says so."""
        if self._painter is None:
            return  # ipywidgets closes what is deleted, and this one was never finished.
        if self in self.running:
            self.running.remove(self)
        self._closing.set()
        self._ready.set()
        self.session.close()
        self._painter.join(PATIENCE)
        for row in (self._bar, *self.switches.values()):
            for control in row.children:
                if hasattr(control, "disabled"):
                    control.disabled = True
        self.words.value = f"{self.words.value.removesuffix(ENDED)}{ENDED}"

    def static_html(self) -> str:
        picture = b64encode(self.picture.value).decode()
        return (
            f'<img alt="what each camera sends" src="data:image/jpeg;base64,{picture}">'
            f"{self.words.value}{self.table.value}"
        )

    # Drawing.

    def paint(self, frame: Frame) -> None:
        """Puts ``frame`` into the widgets that show it."""
        self.picture.value = jpeg(mosaic(frame, self._tile))
        self.words.value = words_html(frame)
        self.table.value = table_html(frame)
        self.play.description = "Play" if frame.pace.phase == "paused" else "Pause"
        self._follow(frame)
        self.painted += 1

    def _follow(self, frame: Frame) -> None:
        """Puts the switches of cameras that were changed where they are now."""
        self._following = threading.get_ident()
        for camera, row in self.switches.items():
            state = frame.camera(camera)
            controls = cast(Any, row.children)
            if state != self._followed[camera]:
                self._followed[camera] = self._states[camera] = state
                _, switch, fails = controls
                offered = state.input in switch.options.values()
                switch.value = state.input if offered else None
                fails.value = state.occlusion.kind
        self._following = None

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
            elif isinstance(latest, NoFrame):
                self.words.value = f"<p>{escape(_words(latest))}</p>"
            self._closing.wait(max(0.0, 1 / PICTURES - (time.monotonic() - began)))

    def _first(self, playing: bool) -> Frame:
        """Waits for the episode to open; where it should not play, until it has paused."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            latest = self.session.latest
            if isinstance(latest, NoFrame) and not latest.passing:
                break
            if isinstance(latest, Frame) and (playing or latest.pace.phase == "paused"):
                break
            self._ready.wait(0.05)
            self._ready.clear()
        return self.frame

    def _send_and_wait(self, command: Command, done: Callable[[Frame], bool]) -> None:
        """Sends a command and waits for a frame that shows it, or a later error. Raises UserError
        where neither comes, as after ``close``."""
        before = self.frame.pace.number
        self.session.send(command)
        deadline = time.monotonic() + PATIENCE
        while not self._closing.is_set():
            frame = self.frame
            if done(frame) or (frame.pace.error and frame.pace.number > before):
                return
            if time.monotonic() >= deadline:
                raise UserError(
                    f"expected the simulation to answer within {PATIENCE:g} s, found no new frame; "
                    "run the cell again"
                )
            time.sleep(0.005)
        raise UserError("this simulation has ended; run the cell again")

    # Controls.

    def _toggle(self) -> None:
        self.session.send(Play() if self.frame.pace.phase == "paused" else Pause())

    def _buttons(self) -> ipywidgets.HBox:
        box: list[ipywidgets.Widget] = [self.play]
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
        known = {modality_of(stream) for stream in frame.world.policy.streams}
        unknown = {"rgb", "depth", "both"} - known if len(known) < 2 else set()
        inputs = {label: value for label, value in INPUTS.items() if value not in unknown}
        switch: Any = ipywidgets.ToggleButtons(
            options=inputs, value=frame.camera(camera.name).input, style={"button_width": "70px"}
        )
        fails: Any = ipywidgets.Dropdown(
            options={row.menu: kind for kind, row in KINDS.items()},
            value=frame.camera(camera.name).occlusion.kind,
            layout={"width": "140px"},
        )

        def choose(**chosen: Any) -> None:
            if self._following != threading.get_ident():
                state = self._states[camera.name] = replace(self._states[camera.name], **chosen)
                self.session.send(SetCamera(camera.name, state))

        switch.observe(lambda change: choose(input=change["new"]), "value")
        fails.observe(lambda change: choose(occlusion=Occlusion(change["new"])), "value")
        label = ipywidgets.Label(camera.label, layout={"width": "100px"})
        return ipywidgets.HBox([label, switch, fails])


def _words(latest: NoFrame | None) -> str:
    """Why there is no frame."""
    return "nothing yet" if latest is None else parts_of(latest.error)[0] or latest.title


def open_env(task: str, render_profile: str, cameras: tuple[CameraSpec, ...] = ()) -> Environment:
    """``make_env`` in the session's thread, which computes on one core (see ``teaching.begin``)."""
    begin()
    return make_env(task, render_profile, cameras)
