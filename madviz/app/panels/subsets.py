"""Every subset: what the policy would do with each set of streams, at this very step."""

from __future__ import annotations

from html import escape

import numpy as np
import viser

from madviz.analysis.shapley import camera_masks
from madviz.app.markup import band, term, track
from madviz.app.panel import Assign, Send
from madviz.app.toolkit import HtmlPanel, SyncedInput, on_use
from madviz.drawing.colours import NOTE, camera_colours
from madviz.session.camera_names import subset_label
from madviz.session.commands import ReadSubsets
from madviz.session.frame import Frame
from madviz.subsets import camera_of, name_of

MIDDLE = 50
"""Percent of an action cell's width where 0 is."""
ONE_BY_ONE = (
    "This policy looks at all its cameras in one pass, so every subset costs a pass. On: between "
    "two decisions as many subsets are read as there is time for; while paused, all."
)
UNTRAINED_Q = "Q was not learned on this subset, so it says little about what follows."
FEW = 16
"""Rows up to which all are shown; six streams have 64, four pages of them."""
NARROW = 4
"""Action numbers up to which the bars of a row have room for figures."""


class SubsetsPanel(HtmlPanel):
    """A table with a row per subset: its action as bars, how far that is from other actions, its Q,
    whether it was trained."""

    def __init__(self, gui: viser.GuiApi, send: Send | None, frame: Frame) -> None:
        """``send`` None: read-only."""
        self._frame = frame
        self._read = gui.add_checkbox("Read every subset", frame.pace.reads_all, hint=ONE_BY_ONE)
        self._reads = SyncedInput(self._read)
        self._read.visible = send is not None and not frame.world.policy.reads_together
        if send is not None:
            on_use(self._read, lambda _, on: send(ReadSubsets(bool(on))))
        self._may_read = send is not None
        self._everything = gui.add_checkbox(
            "Every row", False, hint="Also sets in which a camera gives half of what it could."
        )
        self._everything.visible = len(frame.world.probe.masks) > FEW
        self.handles = [self._read, self._everything]
        super().__init__(gui, frame, self._content)
        on_use(self._everything, lambda *_: self.show(self.update(self._frame)))

    def _content(self, frame: Frame) -> str:
        return subsets_html(frame, bool(self._everything.value))

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        return [
            *super().update(frame),
            Assign(self._everything, "visible", len(frame.world.probe.masks) > FEW),
            Assign(self._read, "visible", self._may_read and not frame.world.policy.reads_together),
            *self._reads.show(frame.pace.reads_all),
        ]


def subsets_html(frame: Frame, everything: bool = True) -> str:
    """The current subset first, then the trained ones, then the rest; of more than ``FEW`` only the
    first two kinds and the sets of whole cameras, unless ``everything`` is asked for."""
    masks = frame.world.probe.masks
    streams = frame.world.policy.streams
    here = frame.row
    probe = frame.world.probe
    trained = frame.trained_rows
    rows = range(len(masks))
    if not everything and len(masks) > FEW:
        shown = {*map(probe.row, camera_masks(streams)), *trained, here}
        rows = [row for row in rows if row in shown]
    order = sorted(rows, key=lambda row: (row != here, row not in trained, row))
    lines = [_row(frame, row, row in trained, row == here) for row in order]
    left_out = len(masks) - len(lines)
    more = f" · {left_out} sets with half a camera are not shown" if left_out else ""
    if probe.waiting[list(rows)].any():
        more += " · not read: every subset costs this policy a pass; see <b>Read every subset</b>"
    key = (
        f'<div class="dim">† {term("not trained on")} · apart: from the action taken now, and from '
        f"the one of all cameras{more}</div>"
    )
    # Recordings have no rewards, so no policy of theirs has a Q.
    q = "" if frame.world.recorded else f'<td class="num">{term("Q")} now</td>'
    head = (
        '<tr class="dim"><td colspan="2">the policy gets</td>'
        f'<td style="width:42%">{term("action")} now</td><td class="num">{term("apart")}: now</td>'
        f'<td class="num">all</td>{q}</tr>'
    )
    return f'<div class="mv"><table>{head}{"".join(lines)}</table>{key}</div>'


def _row(frame: Frame, row: int, trained: bool, here: bool) -> str:
    readout = frame.world.probe.readout
    recorded = frame.world.recorded is not None
    mask = frame.world.probe.masks[row]
    label = escape(subset_label(frame, name_of(mask, frame.world.policy.streams)))
    now = f'<span class="tag" style="background:{NOTE}">now</span> ' if here else ""
    dagger = "" if trained else '<span class="dim" title="not trained on">† </span>'
    if np.isfinite(readout.action[row]).all():
        # Euclidean, from the action taken now, and from that of all streams.
        others = (readout.action[other] for other in (frame.row, 0))
        distances = (float(np.linalg.norm(readout.action[row] - other)) for other in others)
        apart = "".join(
            f'<td class="num">{"–" if np.isnan(d) else f"{d:.2f}"}</td>' for d in distances
        )
        figures = len(readout.action[row]) <= NARROW
        cells = f"<td>{action_bars(readout.action[row], figures)}</td>{apart}"
        cells += "" if recorded else _q(float(readout.q[row]), trained)
    else:
        why = "cannot act on this" if not frame.world.probe.waiting[row] else "not read"
        cells = f'<td class="dim" colspan="{3 if recorded else 4}">{why}</td>'
    style = ' style="background:rgba(255,209,102,0.12)"' if here else ""
    return (
        f"<tr{style}><td>{presence(frame, mask)}</td>"
        f'<td style="max-width:190px;white-space:normal">{now}{dagger}{label}</td>{cells}</tr>'
    )


def _q(value: float, trained: bool) -> str:
    kind = 'class="num"' if trained else f'class="num dim" title="{UNTRAINED_Q}"'
    return f"<td {kind}>{value:.1f}</td>" if np.isfinite(value) else f"<td {kind}>–</td>"


def presence(frame: Frame, mask: np.ndarray) -> str:
    """A square per camera in its colour, filled where it is present; with two modalities the left
    half is colour and the right half depth."""
    colours = camera_colours(frame.world.env.cameras)
    on: dict[str, list[bool]] = {}
    for stream, present in zip(frame.world.policy.streams, mask, strict=True):
        on.setdefault(camera_of(stream), []).append(bool(present))
    squares = ""
    for camera, halves in on.items():
        colour = colours[camera]
        left, right = (colour if half else "transparent" for half in (halves[0], halves[-1]))
        squares += (
            f'<span class="dot" style="border:1.5px solid {colour};margin-right:3px;'
            f'background:linear-gradient(90deg,{left} 50%,{right} 50%)"></span>'
        )
    return squares


def action_bars(action: np.ndarray, figures: bool = True) -> str:
    """(A,) in [-1, 1] as bars from the middle of a cell each, with the number inside; without
    ``figures``, where a mouse points at it."""
    cells = ""
    for value in action:
        width = abs(float(value)) * MIDDLE
        left = MIDDLE if value >= 0 else MIDDLE - width
        number = f"{value:+.2f}"
        inside = f'<div class="num">{number}</div>' if figures else ""
        cell = track(band(left, width, "#5b6b80") + inside, 15)
        cells += cell if figures else f'<div style="flex:1" title="{number}">{cell}</div>'
    return f'<div style="display:flex;gap:3px">{cells}</div>'
