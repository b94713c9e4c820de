"""Cameras that fail by themselves: pick a scenario, or write one, and watch an episode of it."""

from __future__ import annotations

from html import escape

import viser

from madviz.app.panel import Send
from madviz.app.toolkit import Cell, HtmlPanel, on_use, place
from madviz.drawing.colours import NOTE
from madviz.observation.grammar import HOW
from madviz.observation.schedule import (
    SCENARIOS,
    Schedule,
    parse_schedule,
    scenario,
    schedule_words,
)
from madviz.session.commands import Play, Reset, SetSchedule
from madviz.session.frame import Frame

OWN = "my own"
HINTS = {
    "scenario": "Cameras fail at the same steps in every episode, until you end it.",
    "own": f"For example third_a@20-40; {HOW}. Several, with blanks between them.",
    "run": "Starts the same seed again, with these failures.",
    "end": "No more failures; the cameras of the scenario work again.",
}


class FailuresPanel(HtmlPanel):
    """A dropdown of scenarios, a line for one's own, and what is to come."""

    def __init__(self, gui: viser.GuiApi, send: Send | None, frame: Frame) -> None:
        """``send`` None: read-only."""
        self._send = send
        self._env = frame.world.env
        if send is not None:
            self._add_controls(gui)
        super().__init__(gui, frame, failures_html)

    def _add_controls(self, gui: viser.GuiApi) -> None:
        names = [*(one.name for one in SCENARIOS), OWN]
        self._choice = gui.add_dropdown("Scenario", names, hint=HINTS["scenario"])
        self._own = gui.add_text("My own", f"{self._env.cameras[0].name}@10-20", hint=HINTS["own"])
        run = gui.add_button("run scenario", hint=HINTS["run"])
        end = gui.add_button("end it", hint=HINTS["end"])
        on_use(run, lambda *_: self.run())
        on_use(end, lambda *_: self.end())
        cells = [Cell(self._choice, 1, 2), Cell(self._own, 1, 2), Cell(run, 1), Cell(end, 2)]
        self.handles = place(gui, "failures", 2, cells)

    def chosen(self) -> Schedule:
        """Raises UserError for a line of one's own that is none."""
        if self._choice.value != OWN:
            return scenario(self._choice.value).schedule(self._env)
        cameras = [camera.name for camera in self._env.cameras]
        return parse_schedule(self._own.value.replace(",", " ").split(), cameras)

    def run(self) -> None:
        """Starts the episode of the same seed with what was chosen."""
        assert self._send is not None
        for command in (SetSchedule(self.chosen()), Reset(), Play()):
            self._send(command)

    def end(self) -> None:
        assert self._send is not None
        self._send(SetSchedule())


def failures_html(frame: Frame) -> str:
    """The chosen schedule, and which part of it comes next."""
    if not frame.schedule:
        return '<div class="mv dim">No failures are planned: cameras do what you say.</div>'
    name = next((o for o in SCENARIOS if o.schedule(frame.world.env) == frame.schedule), None)
    coming = [event for event in frame.schedule if event.step > frame.world.step]
    head = f"<b>{escape(name.name)}.</b> {escape(name.words)}" if name else "<b>My own.</b>"
    if coming:
        first = coming[0]
        label = next(
            (c.label for c in frame.world.env.cameras if c.name == first.camera), first.camera
        )
        deed = "works again" if first.works else "drops out" if first.dropped else "is occluded"
        after = f"Next, at step {first.step}: {escape(label)} {deed}."
    else:
        after = "All of it has happened in this episode."
    words = "  ".join(schedule_words(frame.schedule))
    return (
        f'<div class="mv">{head} <span style="color:{NOTE}">{after}</span>'
        f'<div class="dim"><code>{escape(words)}</code></div></div>'
    )
