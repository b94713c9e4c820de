"""Train from the page: choose, start, stop, go on, and watch the newest weights at work.

One training for the whole server, whoever started it: two cores hold no more. It is a process of
its own at the lowest priority (``madviz.training.job``); this panel asks it for its state
a few times in ten seconds and draws that.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from html import escape

import viser

from madviz.agent.methods import METHODS
from madviz.app.chart import Lane, chart
from madviz.app.markup import progress_bar
from madviz.app.panel import Assign, Send
from madviz.app.toolkit import Cell, HtmlPanel, notify, on_use, one_at_a_time, place
from madviz.drawing.colours import BAD, GOOD, MUTED, NOTE
from madviz.envs.registry import known_tasks
from madviz.session.commands import SetPolicy
from madviz.session.frame import Frame
from madviz.training.job import OFFERS, JobConfig, JobStatus, TrainingJob

WORDS = {
    "idle": "Nothing is being trained.",
    "running": "Training.",
    "stopping": "Stopping after this round; nothing learned is lost.",
    "stopped": "Stopped. It can go on where it was.",
    "failed": "It failed:",
    "done": "Done.",
}
HINTS = {
    "task": "What is to be learned.",
    "method": "How the cameras are merged and which of them are learned from.",
    "recipe": " ".join(f"{name}: {offer.words}." for name, offer in OFFERS.items()),
    "budget": "trial: minutes, to see it move. short: the recipe's defaults. full: as included.",
    "start": "A process of its own, at the lowest priority: the page stays quick.",
    "stop": "Loses nothing that was learned.",
    "go on": "Goes on exactly where it was stopped.",
    "watch": "Puts the newest weights to work in this page.",
}
WIDTH = 600
HEIGHT = 70
LEFT = 40
"""Pixels of the curves."""
READ_EVERY = 3.0
"""Seconds between two reads of the run's files."""


class TrainingPanel(HtmlPanel):
    """Controls and curves. ``send`` None: read-only."""

    unsettled = True
    """A training goes on while the episode stands still."""

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Send | None,
        frame: Frame,
        job: TrainingJob,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._job = job
        self._clock = clock
        self._read_at = -READ_EVERY
        self._status = JobStatus()
        if send is not None:
            self._add_controls(gui, send, frame)
        super().__init__(gui, frame, lambda _: training_html(self._status))

    def _add_controls(self, gui: viser.GuiApi, send: Send, frame: Frame) -> None:
        task = gui.add_dropdown(
            "Task", known_tasks(), initial_value=frame.world.env.task, hint=HINTS["task"]
        )
        method = gui.add_dropdown(
            "Method", tuple(METHODS), initial_value="mad", hint=HINTS["method"]
        )
        recipe = gui.add_dropdown("Recipe", tuple(OFFERS), hint=HINTS["recipe"])
        budget = gui.add_dropdown("Budget", tuple(OFFERS["light"].budgets), hint=HINTS["budget"])
        on_use(recipe, lambda _, name: setattr(budget, "options", tuple(OFFERS[name].budgets)))

        def start(client: viser.ClientHandle) -> None:
            self._job.start(JobConfig(task.value, method.value, recipe.value, budget.value))
            notify(client, "Training", "The first round takes half a minute to show.")

        work: dict[str, Callable[[viser.ClientHandle], None]] = {
            "start": start,
            "stop": lambda _: self._job.stop(),
            "go on": lambda _: self._job.resume(),
            "watch": lambda _: send(SetPolicy(str(self._job.snapshot()))),
        }
        buttons = [self._button(gui, name, do) for name, do in work.items()]
        cells = [
            Cell(task, 1, 6, "3.6em"),
            Cell(method, 7, 6, "3.6em"),
            Cell(recipe, 1, 6, "3.6em"),
            Cell(budget, 7, 6, "3.6em"),
        ]
        cells += [Cell(button, 1 + 3 * column, 3) for column, button in enumerate(buttons)]
        self.handles = place(gui, "training", 12, cells)

    def _button(
        self, gui: viser.GuiApi, name: str, work: Callable[[viser.ClientHandle], None]
    ) -> viser.GuiButtonHandle:
        button = gui.add_button(name, hint=HINTS[name])

        def press(client: viser.ClientHandle, _: object) -> None:
            try:
                work(client)
            finally:
                self._read_at = -READ_EVERY

        on_use(button, press, one_at_a_time)
        return button

    def update(self, frame: Frame) -> list[Assign]:
        if self._clock() - self._read_at >= READ_EVERY:
            self._read_at = self._clock()
            self._status = self._job.status()
        return super().update(frame)


def training_html(status: JobStatus) -> str:
    """The state in words, how far it is, and two curves."""
    why = f' <span style="color:{NOTE}">{escape(status.why)}</span>' if status.why else ""
    lines = [f"<div><b>{WORDS[status.state]}</b>{why} {_progress(status)}</div>"]
    if status.config is None:
        lines.append(
            '<div class="dim">A look at MAD on the toy task takes a minute; on hammer, some three. '
            "Press <b>watch</b> when there is a policy, and take its cameras away.</div>"
        )
    else:
        lines.append(_facts(status))
    if status.rows:
        lines.append(_curves(status))
    return f'<div class="mv mv-training" data-state="{status.state}">{"".join(lines)}</div>'


def _facts(status: JobStatus) -> str:
    config = status.config
    assert config is not None
    return (
        f'<div class="dim">{escape(config.task)} · {escape(config.method)} · {config.recipe} '
        f"({OFFERS[config.recipe].words}) · {config.budget}</div>"
        f'<div class="dim">in {escape(str(status.folder))}</div>'
    )


def _progress(status: JobStatus) -> str:
    if status.state not in ("running", "stopping"):
        return ""
    left = status.seconds_left
    time_left = f"{left / 60:.0f} min left" if math.isfinite(left) else "time left not known yet"
    return (
        f'<span class="dim num">{100 * status.done:.0f} % · {time_left}</span>'
        f"{progress_bar(status.done, GOOD)}"
    )


def _curves(status: JobStatus) -> str:
    """The loss, and the success of recorded or evaluated episodes where the recipe reports it."""
    losses = [name for name in ("loss", "critic_loss") if name in status.rows[0]]
    rates = [name for name in status.rows[0] if "success" in name]
    parts = [_curve(status, name, MUTED, None) for name in losses[:1]]
    parts += [_curve(status, *row, 1.0) for row in zip(rates[:2], (GOOD, BAD), strict=False)]
    return "".join(parts)


def _curve(status: JobStatus, name: str, colour: str, high: float | None) -> str:
    """``high``: the value at the top of the scale; None: the greatest."""
    values = [row[name] for row in status.rows]
    known = [value for value in values if math.isfinite(value)]
    top = high or max(known, default=1.0) or 1.0
    lane = Lane(LEFT, WIDTH - 6, 10, HEIGHT - 14, max(len(values) - 1, 1), 0.0, top)
    newest = f"{known[-1]:.3g}" if known else "none yet"
    label = escape(name.replace("_", " "))
    return chart(
        WIDTH,
        HEIGHT,
        f'<text x="{LEFT}" y="10">{label}: {newest} (row {len(values)})</text>'
        f"{lane.scale('.2g')}{lane.curve(values, colour)}",
    )
