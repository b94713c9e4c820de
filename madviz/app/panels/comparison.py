"""A against B, on the same seeds, in lock-step: two policies, or one policy with other cameras."""

from __future__ import annotations

from collections.abc import Sequence

import viser

from madviz.app.panel import Assign, Send
from madviz.app.panels.policy import PolicyChoice, PolicyPicker, offered
from madviz.app.toolkit import Cell, HtmlPanel, on_use, place
from madviz.drawing.colours import BAD, FAINT, GOOD, NOTE
from madviz.measure.statistics import Paired
from madviz.policies.checkpoint import has_guard
from madviz.policies.guarded import with_guard
from madviz.session.commands import Compare
from madviz.session.comparison import tally
from madviz.session.frame import Frame

INTRODUCTION = (
    "A is the page. <b>Start B</b> puts a second policy beside it, on the same seeds: the one you "
    "choose here, with the cameras as they are now. Its pictures appear under A's. The switches "
    "act on A and B, until you choose <b>A only</b>."
)
PAST = "B, if there is one, is shown at the newest step only. Its pairs are kept."
CHANCE = (
    "p: how often two equal sides come to look as different as this, if somebody looks after every "
    "pair. The interval is that of a number of pairs which was fixed before."
)
HINTS = {
    "policy": "Who acts on B's side.",
    "start": "B gets this policy and the cameras as they are now; both start the seed again.",
    "stop": "Gives B's share of the machine back.",
}


class ComparisonPanel(HtmlPanel):
    """Controls and the tally. ``send`` None: read-only."""

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Send | None,
        frame: Frame,
        choices: Sequence[PolicyChoice],
    ) -> None:
        self._frame = frame
        self._picker: PolicyPicker | None = None
        names = offered(choices, frame.world.env.task)
        if send is not None and names:
            self._picker = PolicyPicker(gui, "B", names, frame, HINTS["policy"])
            self._add_controls(gui, send, self._picker)
        super().__init__(gui, frame, comparison_html)

    def _add_controls(self, gui: viser.GuiApi, send: Send, picker: PolicyPicker) -> None:
        start = gui.add_button("start B", hint=HINTS["start"])
        stop = gui.add_button("end B", hint=HINTS["stop"])

        def begin(*_: object) -> None:
            name = picker.names[picker.handle.value]
            guarded = self._frame.world.guard is not None and has_guard(name)
            send(Compare(with_guard(name, guarded), self._frame.world.ablation))

        on_use(start, begin)
        on_use(stop, lambda *_: send(Compare(None)))
        cells = [Cell(picker.handle, 1, 6, "1.2em"), Cell(start, 7, 2), Cell(stop, 9, 2)]
        self.handles = place(gui, "versus", 10, cells)

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        changes = super().update(frame)
        if self._picker is not None and frame.second is not None:
            changes += self._picker.show(frame.second)
        return changes


def comparison_html(frame: Frame) -> str:
    """The tally, or what there is to try."""
    if frame.second is None:
        said = PAST if frame.past else INTRODUCTION
    else:
        said = _tally(frame)
    return f'<div class="mv mv-comparison">{said}</div>'


def _tally(frame: Frame) -> str:
    """Pairs of the two sides as they stand now, and what they say."""
    assert frame.second is not None
    first, second = ((side.world.policy, side.condition) for side in (frame, frame.second))
    counted = tally(frame.pairs, (first, second))
    if counted.n == 0:
        return (
            '<span class="dim">A pair counts when an episode ends in which nobody touched either '
            "side. None yet: let one run.</span>"
        )
    return f"{_squares(counted)}{_verdict(counted)}"


def _squares(counted: Paired) -> str:
    """The four counts as a row of bars that share the width by size."""
    parts = [
        (counted.both, "both", GOOD),
        (counted.first_only, "A only", "#ffffff"),
        (counted.second_only, "B only", NOTE),
        (counted.neither, "neither", BAD),
    ]
    bar = "".join(
        f'<div title="{word}" style="flex:{count};background:{colour};height:10px"></div>'
        for count, word, colour in parts
        if count
    )
    words = " · ".join(
        f'<span style="color:{colour}">■</span> {word} <b>{count}</b>'
        for count, word, colour in parts
    )
    return f'<div style="display:flex;background:{FAINT}">{bar}</div><div>{words}</div>'


def _verdict(counted: Paired) -> str:
    """Visitors look after every pair, so p must hold whenever they do."""
    low, high = counted.interval()
    p = counted.any_time()
    said = (
        "They differ."
        if p < 0.05
        else "No difference can be seen yet."
        if counted.first_only + counted.second_only
        else "Every pair came out alike."
    )
    return (
        f"<div>success of A minus B <b>{counted.difference:+.2f}</b> [{low:+.2f}, {high:+.2f}] "
        f'<span class="dim" title="{CHANCE}">n = {counted.n} pairs, 95 %; p = {p:.2g}.</span> '
        f"{said}</div>"
    )
