"""A button that lets a policy imagine its next decisions, and what then happens beside them.

Two rows for each stream, one picture for each of some decisions: what was imagined, and under it,
as the episode goes on, what the camera sees then. Below, the reward that was foreseen and the one
that was got. Nothing of it is there with a policy that has no world model.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import cv2
import numpy as np
import viser

from madviz.analysis.foresight import DECISIONS, Foresight, mean_psnr
from madviz.app.chart import Lane, chart
from madviz.app.panel import Assign, Send
from madviz.app.toolkit import HtmlPanel, on_use
from madviz.drawing.colours import INK, MUTED, NOTE
from madviz.drawing.jpeg import jpeg_url
from madviz.session.camera_names import stream_label
from madviz.session.commands import Foresee
from madviz.session.frame import Frame
from madviz.types import Array

SHOWN = (1, 2, 3, 4, 5, 7, 9, 11, 13, 15)
"""Decisions that have a picture, counted from 1."""
TILE = 52
GAP = 2
"""Pixels of a picture, and between two."""
WIDTH = 600
HEIGHT = 64
LEFT = 44
"""Units of the reward's drawing, and left of it."""
HINT = "From this step on, with the cameras that are on now. The episode goes on meanwhile."
_GROUND = 30


class ForesightPanel(HtmlPanel):
    """A button and what came of it. ``send`` None: read-only."""

    def __init__(self, gui: viser.GuiApi, send: Send | None, frame: Frame) -> None:
        self._of: Foresight | None = None
        self._drawn = ""
        self._button: Any = None
        if send is not None:
            self._button = gui.add_button(f"imagine {DECISIONS} decisions", hint=HINT)
            self._button.visible = frame.world.foresees
            on_use(self._button, lambda *_: send(Foresee()))
            self.handles = [self._button]
        super().__init__(gui, frame, self._content)

    def update(self, frame: Frame) -> list[Assign]:
        changes = super().update(frame)
        if self._button is not None:
            changes.append(Assign(self._button, "visible", frame.world.foresees))
        return changes

    def _content(self, frame: Frame) -> str:
        """Drawn anew where something has happened since."""
        if frame.foresight is not self._of:
            self._of = frame.foresight
            self._drawn = foresight_html(self._of, frame) if self._of else ""
        return self._drawn


def foresight_html(foresight: Foresight, frame: Frame) -> str:
    """The pictures, the reward and a sentence."""
    rows = [_row("after decision", _numbers())]
    for index, stream in enumerate(foresight.streams):
        imagined = [foresight.future.pictures[n - 1, index] for n in SHOWN]
        happened = [
            foresight.happened[n - 1].pictures[index] if n <= len(foresight.happened) else None
            for n in SHOWN
        ]
        label = stream_label(frame, stream)
        rows.append(_row(f"{escape(label)}, imagined", _pictures(imagined, f"{label} imagined")))
        rows.append(_row("what happened", _pictures(happened, f"{label} as it happened"), "dim"))
    return (
        f'<div class="mv mv-foresight"><div>{foresight_words(foresight)}</div>'
        f"{''.join(rows)}{_reward_svg(foresight)}</div>"
    )


def foresight_words(foresight: Foresight) -> str:
    """``Imagined at step 12 from all. Of 15 decisions 7 have happened: ...``"""
    count = len(foresight.happened)
    many = len(foresight.future.reward)
    said = f"Imagined at step {foresight.step} from <b>{escape(foresight.condition)}</b>, without "
    said += f"another picture. Of {many} decisions {count} have been taken since"
    said += ", then the episode was over" if foresight.closed and count < many else ""
    psnr = mean_psnr(foresight)
    said += f"; imagined pictures have {psnr:.1f} dB where something moves." if count else "."
    if foresight.disturbed:
        said += " Cameras were changed meanwhile, so what happened is no test of it."
    return said


def _row(label: str, content: str, style: str = "") -> str:
    left = f'<div class="{style}" style="width:8.5em;flex:none;font-size:11px">{label}</div>'
    return f'<div style="display:flex;align-items:center;gap:4px">{left}{content}</div>'


def _numbers() -> str:
    pitch = 100 / len(SHOWN)
    cells = "".join(f'<span style="width:{pitch}%;text-align:center">{n}</span>' for n in SHOWN)
    return f'<div style="display:flex;flex:1;font-size:11px;color:{MUTED}">{cells}</div>'


def _pictures(pictures: Sequence[Array | None], words: str) -> str:
    """All of a row in one image; what is not known yet is dark."""
    strip = np.full((TILE, len(pictures) * (TILE + GAP), 3), _GROUND, np.uint8)
    for column, picture in enumerate(pictures):
        if picture is not None:
            left = column * (TILE + GAP) + GAP // 2
            small = cv2.resize(picture, (TILE, TILE), interpolation=cv2.INTER_AREA)
            strip[:, left : left + TILE] = small if small.ndim == 3 else small[..., None]
    return (
        f'<img src="{jpeg_url(strip)}" alt="{escape(words)}" '
        'style="flex:1;min-width:0;display:block;margin:1px 0">'
    )


def _reward_svg(foresight: Foresight) -> str:
    """Foreseen as a dashed line, got as a solid one."""
    foreseen = [float(r) for r in foresight.future.reward]
    got = [one.reward for one in foresight.happened]
    known = [r for r in (*foreseen, *got) if np.isfinite(r)] or [0.0]
    right = WIDTH - 106
    top = 8
    low = min(*known, 0.0)
    lane = Lane(LEFT, right, top, HEIGHT - 8, len(foreseen) - 1, low, max(*known, 1e-6))
    dashed = 'stroke-dasharray="5 3"'
    return chart(
        WIDTH,
        HEIGHT,
        f"{lane.scale('.2f')}{lane.curve(foreseen, NOTE, 1.8, dashed)}"
        f"{lane.curve(got, INK, 1.8)}"
        f'<text x="{right + 8}" y="{top + 10}" fill="{NOTE}">reward foreseen</text>'
        f'<text x="{right + 8}" y="{top + 28}" fill="{INK}">reward got</text>',
    )
