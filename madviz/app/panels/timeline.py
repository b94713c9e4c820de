"""The episode so far: drag back to any step, and try another run from there.

Two lanes, reward and Q by step, with a mark wherever cameras or the policy changed; a recording has
one, the distance from it. After a fork, the original run stays as a dashed line, with its pictures
at the same step under it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from html import escape
from typing import Literal

import numpy as np
import viser

from madviz.app.chart import Lane, chart
from madviz.app.panel import Assign, Send
from madviz.app.pictures import strip_html
from madviz.app.toolkit import Cell, HtmlPanel, SyncedInput, on_use, place
from madviz.drawing.colours import BAD, GOOD, MUTED, NOTE
from madviz.session.commands import Fork, Scrub
from madviz.session.frame import Frame, TimelinePoint

LaneName = Literal["reward", "q"]
WIDTH = 600
LANE = 40
LEFT = 44
TOP = 14
"""Pixels of the drawing, of a lane, left of the lanes and above them."""
AFTER_DRAG = 1.0
"""Seconds in which a slider that is being dragged is left alone."""
HINTS = {
    "step": "Drag back to see everything as it was at an earlier step.",
    "fork": "Go on from the step that is shown, with the cameras as they were then. "
    "Switching a camera there forks, too.",
    "live": "Back to the newest step.",
}


class TimelinePanel(HtmlPanel):
    """A slider over the steps, two lanes, and the branch. ``send`` None: read-only."""

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Send | None,
        frame: Frame,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._send = send
        self._clock = clock
        self._horizon = frame.world.env.horizon
        self._slider: SyncedInput | None = None
        self._dragged = -AFTER_DRAG
        self._crossed = False
        """When a visitor moved the slider last, and whether it was set right since."""
        if send is not None:
            self._add_controls(gui, send, frame)
        super().__init__(gui, frame, timeline_html)

    def _add_controls(self, gui: viser.GuiApi, send: Send, frame: Frame) -> None:
        slider = gui.add_slider(
            "Step", 0, self._horizon, 1, frame.world.step, marks=(), hint=HINTS["step"]
        )
        on_use(slider, lambda _, value: self._drag(int(value)))
        fork = gui.add_button("fork here", hint=HINTS["fork"])
        live = gui.add_button("newest", hint=HINTS["live"])
        for button, command in ((fork, Fork()), (live, Scrub(None))):
            on_use(button, lambda *_, command=command: send(command))
        self._slider = SyncedInput(slider)
        cells = [Cell(slider, 1, 8, "3em"), Cell(fork, 9, 3), Cell(live, 12, 3)]
        self.handles = place(gui, "timeline", 14, cells)

    @property
    def unsettled(self) -> bool:
        """Whether the slider is yet to be set right after a drag."""
        return self._crossed

    def _drag(self, step: int) -> None:
        assert self._send is not None
        self._dragged = self._clock()
        self._crossed = True
        self._send(Scrub(step))

    def update(self, frame: Frame) -> list[Assign]:
        changes = super().update(frame)
        if self._slider is None or self._clock() - self._dragged < AFTER_DRAG:
            return changes
        if not self._crossed:
            return [*changes, *self._slider.show(frame.world.step)]
        # A value of ours may have crossed the visitor's on its way, and viser sends none that it
        # believes to be there: another one between makes sure.
        self._crossed = False
        changes += self._slider.show(frame.world.step - 1 if frame.world.step else 1, force=True)
        return [*changes, *self._slider.show(frame.world.step, force=True)]


def timeline_html(frame: Frame) -> str:
    """The lanes and what stands under them."""
    # Recordings have no rewards, so no policy of theirs has a Q.
    lanes: tuple[LaneName, ...] = ("reward",) if frame.world.recorded else ("reward", "q")
    drawn = "".join(_lane(frame, name, index) for index, name in enumerate(lanes))
    height = TOP + len(lanes) * (LANE + 8) + 18
    svg = chart(WIDTH, height, f"{_marks(frame, height)}{drawn}{_axis(frame, height)}")
    return f'<div class="mv mv-timeline">{svg}<div>{_words(frame)}</div>{_first(frame)}</div>'


def marks(history: Sequence[TimelinePoint]) -> list[tuple[int, str]]:
    """The steps at which a visitor changed what the policy gets, or the policy, and to what."""
    found = []
    for step in range(1, len(history)):
        before = history[step - 1]
        now = history[step]
        if now.policy != before.policy:
            found.append((step, now.policy))
        elif now.condition != before.condition:
            found.append((step, str(now.condition)))
    return found


def _x(step: float, horizon: int) -> float:
    return LEFT + (WIDTH - LEFT - 6) * step / horizon


def _lane(frame: Frame, name: LaneName, index: int) -> str:
    """One curve over the original run's, on one scale that holds both."""
    live = [getattr(moment, name) for moment in frame.history]
    first = [getattr(moment, name) for moment in frame.branch.history] if frame.branch else []
    known = np.array([*live, *first], float)
    known = known[np.isfinite(known)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    low = min(low, 0.0)
    high = max(high, low + 1e-6, 1e-6)
    top = TOP + index * (LANE + 8) + 4
    lane = Lane(LEFT, WIDTH - 6, top, top + LANE, frame.world.env.horizon, low, high)
    first_lane = "reward" if frame.world.recorded is None else "apart"
    label = {"reward": first_lane, "q": "Q"}[name]
    dashed = 'stroke-dasharray="4 4" stroke-opacity="0.8"'
    return (
        f'{lane.scale(".3g")}<text x="4" y="{top + LANE / 2 + 4}">{label}</text>'
        f"{lane.curve(first, NOTE, 1, dashed)}{lane.curve(live, '#fff')}"
    )


def _marks(frame: Frame, height: int) -> str:
    """Changes as dashed lines, the fork as a yellow one, goal met as a blue floor, the cursor."""
    horizon = frame.world.env.horizon
    parts = []
    for step, text in marks(frame.history):
        x = _x(step, horizon)
        parts.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{height - 16}" stroke="{MUTED}" '
            f'stroke-dasharray="2 3"><title>step {step}: {escape(text)}</title></line>'
            f'<text x="{min(x + 3, WIDTH - 120):.1f}" y="10">{escape(_short(text))}</text>'
        )
    if frame.branch:
        x = _x(frame.branch.at, horizon)
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{height - 16}" stroke="{NOTE}"/>')
    for step, moment in enumerate(frame.history):
        if moment.success:
            parts.append(
                f'<rect x="{_x(step - 0.5, horizon):.1f}" y="{height - 18}" height="3" '
                f'width="{_x(1, horizon) - _x(0, horizon):.2f}" fill="{GOOD}"/>'
            )
    x = _x(frame.world.step, horizon)
    parts.append(
        f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{height - 14}" stroke="#fff" '
        f'stroke-width="{2.5 if frame.past else 1}" stroke-opacity="0.7"/>'
    )
    return "".join(parts)


def _axis(frame: Frame, height: int) -> str:
    horizon = frame.world.env.horizon
    return "".join(
        f'<text x="{_x(step, horizon):.1f}" y="{height - 3}" '
        f'text-anchor="{"end" if step == horizon else "middle"}">{step}</text>'
        for step in range(0, horizon + 1, max(1, horizon // 5))
    )


def _short(text: str) -> str:
    return text if len(text) <= 20 else text[:19] + "…"


def _words(frame: Frame) -> str:
    goal = f'<span style="color:{GOOD}">▂</span> goal met'
    if frame.world.recorded is not None:
        goal = "apart: the policy's action from the recorded one"
    if frame.past:
        newest = len(frame.history) - 1
        return (
            f'<b style="color:{NOTE}">Looking back: step {frame.world.step} of {newest}.</b> '
            "Switch a camera here, or fork, and another run begins. Play goes on from the "
            "newest step."
        )
    if frame.branch:
        return (
            f'<span style="color:{NOTE}">╌╌</span> the original run, forked at step '
            f"{frame.branch.at} · <b>—</b> this one · {goal}"
        )
    return f'<span class="dim">Drag the step back to see everything as it was · {goal}</span>'


def _first(frame: Frame) -> str:
    """The original run's cameras at the same step, and how the two compare."""
    if frame.branch is None or frame.past:
        return ""
    other = frame.branch.frame
    history = frame.branch.history
    rows = [
        (
            "original run",
            str(other.condition),
            other.world.total_reward,
            _outcome(history, frame),
        ),
        ("now", str(frame.condition), frame.world.total_reward, _outcome(frame.history, frame)),
    ]
    table = "".join(
        f"<tr><td><b>{who}</b></td><td>{escape(_short(what))}</td>"
        f'<td class="num">{total:.0f}</td><td>{end}</td></tr>'
        for who, what, total, end in rows
    )
    head = '<tr class="dim"><td></td><td>policy gets</td><td class="num">reward</td><td></td></tr>'
    return (
        '<div style="display:flex;gap:10px;margin-top:4px;align-items:center">'
        f'<div><div class="dim">the original run, step {other.world.step}</div>'
        f"{strip_html(other, 'the original run')}</div>"
        f'<table style="width:auto">{head}{table}</table></div>'
    )


def _outcome(history: Sequence[TimelinePoint], frame: Frame) -> str:
    """How a run ended, or how far it came; success counts at the last step."""
    if not history[-1].last:
        return f'<span class="dim">up to step {len(history) - 1}</span>'
    if frame.world.recorded is not None:
        return "the end"
    word, colour = ("✔ SUCCESS", GOOD) if history[-1].success else ("✘ FAIL", BAD)
    return f'<b style="color:{colour}">{word}</b>'
