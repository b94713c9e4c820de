"""Where a recording is shown, what stands in place of success: how far actions are apart.

The policy's action from the recorded one, and from its own action with a camera more or less; now,
and on average over the steps of this episode that the page has shown since cameras were changed.
Below, both actions number by number, and whether the policy was trained on this episode.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from html import escape

import numpy as np
import viser

from madviz.app.markup import dot
from madviz.app.toolkit import HtmlPanel
from madviz.drawing.colours import camera_colours
from madviz.errors import UserError
from madviz.policies.checkpoint import robot_of_policy
from madviz.policies.no_policy import NO_POLICY
from madviz.recorded.known import recordings_of
from madviz.recorded.recordings import Recordings
from madviz.recorded.robot import Robot
from madviz.recorded.scaling import each_apart
from madviz.session.frame import Frame
from madviz.session.open_loop import from_recorded, without_camera
from madviz.subsets import cameras_of

UNIT = (
    "1 is a standard deviation of the recorded actions, as a root mean square over their numbers. "
    "The robot did not follow this policy, so nobody knows what would have come of it."
)
SCALED = "-1 and 1 are the least and largest of training"
WITHOUT = (
    "There is no policy here: the cameras change nothing. "
    "<b>madviz train --recording</b> makes one, <b>--policy</b> shows it."
)


class RecordedPanel(HtmlPanel):
    """A table of distances, and both actions, number by number."""

    def __init__(self, gui: viser.GuiApi, frame: Frame) -> None:
        self._learned: tuple[object, str] = (None, "")
        """Policy and episode that were looked up last, and what ``_training`` says of them."""
        self._episode = frame.world.episode
        self._seen: dict[int, tuple[object, dict[str, float]]] = {}
        """By step, the policy and the cameras as they were, and the distances by their names."""
        super().__init__(gui, frame, self._content)

    def note(self, frame: Frame) -> None:
        """See ``panel.Panel``."""
        if frame.world.episode != self._episode:
            self._episode = frame.world.episode
            self._seen = {}
        self._seen[frame.world.step] = (_key(frame), distances(frame))

    def _content(self, frame: Frame) -> str:
        self.note(frame)
        alike = [
            found
            for step, (key, found) in self._seen.items()
            if step <= frame.world.step and key == _key(frame)
        ]

        def mean(name: str) -> float:
            return float(np.mean([found[name] for found in alike]))

        return recorded_html(frame, mean, self._training(frame))

    def _training(self, frame: Frame) -> str:
        """The sentence on whether the policy was trained on this episode."""
        recorded = frame.world.recorded
        key = (frame.world.policy, recorded.episode if recorded else None)
        if key != self._learned[0] and recorded is not None:
            robot = None
            with suppress(UserError):
                robot = robot_of_policy(frame.world.reference)
            recordings = recordings_of(frame.world.env.task)
            self._learned = (key, training_words(robot, recordings, recorded.episode))
        return self._learned[1]


def training_words(robot: Robot | None, recordings: Recordings, episode: int) -> str:
    """The sentence on whether the policy of ``robot`` was trained on ``episode``."""
    if robot is None or not robot.trained_on:
        return "It is not known whether the policy was trained on this episode."
    if not robot.learned_from(recordings, episode):
        return "The policy was not trained on this episode."
    unseen = robot.unseen(recordings)
    numbers = [str(i) for i, one in enumerate(recordings.episodes) if one.index in unseen]
    where = f"number {numbers[0]} is new to it" if numbers else "it was trained on all"
    return f"The policy was trained on this episode, so it may know these actions; {where}."


def _key(frame: Frame) -> object:
    """The policy, and the cameras as they are."""
    return frame.world.policy, frame.condition


def distances(frame: Frame) -> dict[str, float]:
    """From the recording, by ''; with and without a camera, by its name."""
    cameras = cameras_of(frame.world.policy.streams)
    return {"": from_recorded(frame)} | {name: without_camera(frame, name) for name in cameras}


def recorded_html(frame: Frame, mean: Callable[[str], float], training: str = "") -> str:
    """The tables; ``mean`` is that of the steps so far, by the names of ``distances``; ``training``
    as ``training_words`` has it."""
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
    return (
        f'<div class="mv mv-apart"><h4>How far actions are apart</h4><div>{training}</div>'
        '<table><tr class="dim"><td></td><td class="num">now</td><td class="num">mean</td></tr>'
        f'{rows}</table><div class="dim">{UNIT}</div>{_numbers(frame)}</div>'
    )


def _numbers(frame: Frame) -> str:
    """A row for each number of the action: the policy's, the recorded one, how far they are
    apart."""
    assert frame.world.recorded is not None
    ours = frame.action
    recorded = frame.world.recorded.action
    names = recordings_of(frame.world.env.task).action_names
    each = each_apart(ours, recorded, frame.world.env.action_spread)  # (A,)
    rows = "".join(
        f"<tr><td>{escape(name)}</td>"
        + "".join(f'<td class="num">{_number(float(value))}</td>' for value in values)
        + "</tr>"
        for name, *values in zip(names, ours, recorded, each, strict=True)
    )
    head = "".join(f'<td class="num">{word}</td>' for word in ("policy", "recorded", "apart"))
    return (
        f'<h4>Action by number</h4><table><tr class="dim"><td>{SCALED}</td>{head}</tr>'
        f"{rows}</table>"
    )


def _number(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "–"
