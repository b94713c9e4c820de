"""Where a recording is shown, what stands in place of success: how far actions are apart.

The policy's action from the recorded one, and from its own action with a camera more or less; now,
and on average over the steps of this episode that the page has shown.
"""

from __future__ import annotations

from collections.abc import Callable
from html import escape

import numpy as np
import viser

from madviz.app.markup import dot
from madviz.app.panel import Assign
from madviz.app.panels.subsets import action_bars
from madviz.app.toolkit import WidgetPanel
from madviz.drawing.colours import camera_colours
from madviz.policies.no_policy import NO_POLICY
from madviz.session.frame import Frame
from madviz.session.open_loop import from_recorded, without_camera
from madviz.subsets import cameras_of

UNIT = (
    "1 is a standard deviation of the recorded actions, as a root mean square over their numbers. "
    "The robot did not follow this policy, so nobody knows what would have come of it."
)
WITHOUT = (
    "There is no policy here: the cameras change nothing. "
    "<b>madviz train --recording</b> makes one, <b>--policy</b> shows it."
)


class RecordedPanel(WidgetPanel):
    """A table of distances, and the recorded action."""

    def __init__(self, gui: viser.GuiApi, frame: Frame) -> None:
        self._episode = frame.world.episode
        self._seen: dict[int, dict[str, float]] = {}
        """By step, the distances by what they are called."""
        self._text = gui.add_html("")
        self.handles = [self._text]
        self._text.content = self._html(frame)

    def note(self, frame: Frame) -> None:
        """See ``panel.Panel``."""
        if frame.world.episode != self._episode:
            self._episode = frame.world.episode
            self._seen = {}
        self._seen[frame.world.step] = distances(frame)

    def update(self, frame: Frame) -> list[Assign]:
        return [Assign(self._text, "content", self._html(frame))]

    def _html(self, frame: Frame) -> str:
        self.note(frame)
        before = [seen for step, seen in self._seen.items() if step <= frame.world.step]

        def mean(name: str) -> float:
            return float(np.mean([seen[name] for seen in before]))

        return recorded_html(frame, mean)


def distances(frame: Frame) -> dict[str, float]:
    """From the recording, by ''; with and without a camera, by its name."""
    cameras = cameras_of(frame.world.policy.streams)
    return {"": from_recorded(frame)} | {name: without_camera(frame, name) for name in cameras}


def recorded_html(frame: Frame, mean: Callable[[str], float]) -> str:
    """The table; ``mean`` is that of the episode so far, by the names of ``distances``."""
    if frame.world.policy.method == NO_POLICY or frame.world.recorded is None:
        return f'<div class="mv dim">{WITHOUT}</div>'
    colours = camera_colours(frame.world.env.cameras)
    rows = ""
    for name, now in distances(frame).items():
        label = "the policy from the recording"
        if name:
            camera = escape(frame.world.env.camera(name).label)
            label = f"{dot(colours[name])}with and without {camera}"
        cells = "".join(f'<td class="num">{_number(each)}</td>' for each in (now, mean(name)))
        rows += f"<tr><td>{label}</td>{cells}</tr>"
    bars = action_bars(np.clip(frame.world.recorded.action, -1, 1))
    return (
        '<div class="mv mv-apart"><h4>How far actions are apart</h4>'
        '<table><tr class="dim"><td></td><td class="num">now</td><td class="num">mean</td></tr>'
        f'{rows}</table><div class="dim">{UNIT}</div><h4>Recorded action</h4>{bars}</div>'
    )


def _number(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "–"
