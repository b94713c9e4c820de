"""The switch that lays a saliency map over every picture, and the words that go with it.

It is off until somebody wants it: a map is 50 ms of the thread that owns simulator and policy. The
maps themselves are drawn into the tiles (``mosaic.py``).
"""

from __future__ import annotations

from collections.abc import Callable

import viser

from madviz.analysis.saliency import Target
from madviz.app.toolkit import Cell, Choice, HtmlPanel, place
from madviz.session.frame import Frame

OPTIONS: dict[str, str] = {"": "off", "q": "for its Q", "action": "for its action"}

HINT = "Lights up the pixels that matter; takes as long as a step."


class SaliencyPanel(HtmlPanel):
    """Three buttons and a line. ``ask`` None: read-only."""

    def __init__(
        self, gui: viser.GuiApi, ask: Callable[[Target | None], None] | None, frame: Frame
    ) -> None:
        self._choice: Choice | None = None
        if ask is not None:

            def choose(_: viser.ClientHandle, value: str) -> None:
                ask(value or None)  # type: ignore[arg-type]

            self._choice = Choice(gui, "Saliency", OPTIONS, choose, HINT)
            cell = Cell(self._choice.handle, 1, 1, "7.5em")
            self.handles = place(gui, "saliency", 1, [cell])
        super().__init__(gui, frame, self._content)

    def _content(self, frame: Frame) -> str:
        style = self._choice.style(frame.explained or "") if self._choice else ""
        said = saliency_words(frame)
        return f'<style>{style}</style><div class="mv mv-saliency dim">{said}</div>'


def saliency_words(frame: Frame) -> str:
    """The sentence that says what the colours on the pictures mean, or why there are none."""
    if frame.explained is None:
        return "Shows on every picture which of its pixels the policy's output depends on."
    if frame.saliency is not None:
        what = "the norm of its action" if frame.explained == "action" else "its Q"
        return (
            f"Bright: if this pixel changed a little, {what} would change most (SmoothGrad, twice "
            "a second). All pictures share one scale: a dark one hardly counts."
        )
    if frame.past:
        return "Not for an earlier step: go back to the newest one."
    if frame.pace.speed is None and frame.pace.phase == "playing":
        return "Not at full speed: choose a slower one, or pause."
    if not frame.world.probe.supported[frame.row]:
        return "This policy cannot act on these cameras, so there is nothing to explain."
    return (
        "Nothing yet. The first time takes some seconds; a policy not made with torch never "
        "has one."
    )
