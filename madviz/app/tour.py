"""A tour of two minutes for newcomers, and help for everybody.

A tour is a list of steps. Each one says something in plain words and does it on the page at the
same time, with the commands that a visitor's click would send, so that the page itself is the
picture beside the text:

    1 the page ─► 2 drop a camera ─► 3 switch it on again ─► 4 black instead ─► 5 a single camera
               ─► 6 another policy ─► 7 back in time ─► 8 your turn

Steps that make no sense here (another policy where there is none, a single camera of one) are left
out, and the count says so. However it ends, cameras, policy and pace are as they were before it.
Watchers see what the presenter's tour does, and are not offered one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from html import escape
from typing import Any, NamedTuple

import viser

from madviz.app.panels.policy import PolicyChoice
from madviz.app.toolkit import Cell, guarded, heard, place, theme
from madviz.observation.ablation import CameraInput, CameraState, Occlusion, OcclusionKind
from madviz.session.commands import Command, Play, Reset, Scrub, SetCamera, SetPolicy, SetSpeed
from madviz.session.frame import Frame, NoFrame, untouched
from madviz.types import PolicySpec

WIDTH = 300
"""Pixels of the tour's window: at 1280 the scene between the panels has 320."""
BACK = 10
"""Steps that the tour goes back in time."""

TOUR_BUTTON, HELP_BUTTON = "2-minute tour", "help, keys"

HELP = """
**What this is.** A robot works at a task. Several cameras watch it; a *policy*, a trained network,
gets their pictures and says how the hand moves next. You may take cameras away while it works.

**off** takes a camera away: nothing of it is added. **black**, **noise**, **freeze**, **blur**,
**patch**, **lossy** and **late** break it instead: it still sends pictures, but bad ones.

**merged** is what the policy acts on: what it makes of each camera's picture, added up.

**Q** is how much reward the policy expects from here on. **action** is how the hand moves next.

**Subsets** shows what it would do, at this time step, with every other choice of cameras.

Rest the pointer on a control's name, and it says what it does. Ctrl + K (or ⌘ + K) finds every
command by name.
"""


class Step(NamedTuple):
    """What is said, and what is done meanwhile."""

    title: str
    words: str
    commands: tuple[Command, ...] = ()
    back: int = 0
    """How many steps to look back."""


def steps(frame: Frame, choices: Sequence[PolicyChoice]) -> list[Step]:
    """The tour of what ``frame`` shows, beginning with all cameras and the policy that acts now."""
    return list(_steps(frame, choices))


def _steps(frame: Frame, choices: Sequence[PolicyChoice]) -> Iterator[Step]:
    cameras = frame.world.env.cameras
    label = [camera.label for camera in cameras]
    middle, last = len(cameras) // 2, len(cameras) - 1
    yield Step(
        "What you see",
        f"A robot works at a task; it is done when: {frame.world.env.success}. The pictures on the "
        "left are all that the robot's policy gets. Nothing here is a recording: it decides anew "
        "at every step, now, on this machine.",
        (*whole(frame), SetSpeed(10.0), Reset(), Play()),
    )
    yield Step(
        "A camera is dropped",
        f"We have just dropped {label[middle]}: its picture is dim. The line under the pictures "
        "says by how much the robot's next movement has changed. Does it still do its task?",
        (_camera(frame, middle, "off"),),
    )
    yield Step(
        "The camera is back",
        f"{label[middle]} is back, and the movement is as it was. The robot did not have to start "
        "again: the features of all cameras are added up anew at every step.",
        (_camera(frame, middle),),
    )
    yield Step(
        "Black is not dropped",
        f"{label[last]} sends a black picture now. That is worse than no picture: the feature of a "
        "black picture is added to the others. A camera that breaks is better dropped.",
        (_camera(frame, last, kind="black"),),
    )
    if len(cameras) > 1:
        yield Step(
            f"Only {label[0]}",
            "Now one camera is left, the others are dropped. The tab Subsets shows what it would "
            "do, at this very time step, with every other choice of cameras.",
            (
                _camera(frame, 0),
                *(_camera(frame, index, "off") for index in range(1, len(cameras))),
            ),
        )
    other = never_alone(frame.world.policy, choices)
    if other is not None:
        yield Step(
            "Another policy",
            "The same camera, but another policy: this one learned with all cameras and never with "
            "a single one. Watch the success under the pictures, and how the hand moves.",
            (SetPolicy(other), Reset(), Play()),
        )
    yield Step(
        "Back in time",
        "It has stopped, and the page shows what was a few steps ago, as it was then. The tab "
        "Timeline has a slider for that: go back, drop a camera there, and see another run.",
        back=BACK,
    )
    yield Step(
        "Your turn",
        "Press off under any picture, or the keys 1, 2, 3; space stops and goes on. Which camera "
        "can this robot do without, and when? The button help, keys has the rest.",
        (Play(), *whole(frame)),
    )


def whole(frame: Frame) -> tuple[Command, ...]:
    """Commands for all cameras as nobody has touched them, and the policy of ``frame``."""
    cameras = (_camera(frame, index) for index in range(len(frame.world.env.cameras)))
    return (SetPolicy(frame.world.policy.name), *cameras)


def never_alone(policy: PolicySpec, choices: Sequence[PolicyChoice]) -> str | None:
    """The name of the policy like this one that learned with all cameras only, if it is offered."""
    wanted = policy.name.replace("-mad-", "-merged-only-")
    names = [choice.name for choice in choices]
    return wanted if wanted != policy.name and wanted in names else None


def _camera(
    frame: Frame, index: int, switch: CameraInput | None = None, kind: OcclusionKind = "none"
) -> SetCamera:
    state = CameraState(switch or untouched(frame.world.policy).input, Occlusion(kind))
    return SetCamera(frame.world.env.cameras[index].name, state)


class Tour:
    """The two buttons, the tour's window, and the help."""

    def __init__(
        self,
        client: viser.ClientHandle,
        send: Callable[[Command], None] | None,
        newest: Callable[[], Frame | NoFrame | None],
        choices: Sequence[PolicyChoice],
        keys: Sequence[tuple[str, str]],
    ) -> None:
        """``send`` None: a watcher, who gets help only. ``keys``: (key, what it does)."""
        self._client, self._send, self._newest = client, send, newest
        self._choices, self._keys = choices, keys
        self._panel: viser.PanelHandle | None = None
        self._help: Any = None
        self._start: Frame | None = None
        self._steps: list[Step] = []
        self._at, self._acting = 0, ""
        gui = client.gui
        options = (HELP_BUTTON,) if send is None else (TOUR_BUTTON, HELP_BUTTON)
        self._row = gui.add_button_group(
            "New here?",
            options,
            hint="What there is to try; what words and keys (?) mean.",
        )
        self._row.on_click(heard(lambda event: self._pressed(event.target.value)))

    def _pressed(self, button: str) -> None:
        if button == TOUR_BUTTON:
            self.begin()
        elif button == HELP_BUTTON:
            self.help()

    def begin(self) -> None:
        """Opens the tour's window at its first step."""
        frame = self._newest()
        if isinstance(frame, Frame) and self._send is not None and self._panel is None:
            self._start, self._steps, self._at = frame, steps(frame, self._choices), 0
            self._acting = frame.world.policy.name
            self._open()
            self._show()

    def _open(self) -> None:
        gui = self._client.gui
        self._panel = gui.add_panel()
        self._panel.float(x=10, y=-10, width=WIDTH)
        with self._panel.add_tab("Tour", viser.Icon.ROUTE):
            self._text = gui.add_html("")
            self._next = gui.add_button("next step", hint="The tour's next step.")
            self._end = gui.add_button("end the tour", hint="Everything as it was before the tour.")
            place(gui, "tour-steps", 2, [Cell(self._next, 1), Cell(self._end, 2)])
        self._next.on_click(heard(lambda _: self.next()))
        self._end.on_click(heard(lambda _: self.end()))

    def next(self) -> None:
        """One step on; after the last one the tour is over."""
        if self._panel is None:
            return
        self._at += 1
        if self._at < len(self._steps):
            self._show()
        else:
            self.end()

    def end(self) -> None:
        """Closes the window; cameras, policy and speed are as they were."""
        panel, self._panel = self._panel, None
        if panel is None or self._start is None:
            return
        panel.remove()
        # First to the newest step: a camera that is touched in the past begins another run.
        self._do((Play(), *restored(self._start)))

    def _show(self) -> None:
        step, count = self._steps[self._at], len(self._steps)
        self._text.content = step_html(step, self._at + 1, count)
        if self._at + 1 == count:
            self._next.visible = False
        frame = self._newest()
        if step.back and isinstance(frame, Frame):
            self._do((Scrub(max(0, frame.world.step - step.back)),))
        self._do(step.commands)

    def _do(self, commands: Sequence[Command]) -> None:
        send = self._send
        for command in commands:
            if isinstance(command, SetPolicy):
                if command.name == self._acting:  # Loading it again would take a moment.
                    continue
                self._acting = command.name
            if send is not None:
                guarded(self._client, lambda command=command: send(command))

    def help(self) -> None:
        """What the words mean, what the keys do, and light or dark."""
        gui = self._client.gui
        if self._help is not None and not self._help.closed:
            self._help.close()  # A browser that shows none of them could ask for thousands.
        modal = self._help = gui.add_modal("Help and keys")
        with modal:
            gui.add_markdown(HELP)
            if self._keys:
                gui.add_markdown(keys_table(self._keys))
            shade = gui.add_button_group(
                "This page", ("dark", "light"), hint="Only here; other visitors choose theirs."
            )
            shade.on_click(heard(lambda event: theme(gui, event.target.value == "light")))
            gui.add_button("close").on_click(heard(lambda _: modal.close()))

    def remove(self) -> None:
        """Takes all of it off the page, without touching the simulation."""
        if self._panel is not None:
            self._panel.remove()
            self._panel = None
        self._row.remove()


def restored(frame: Frame) -> tuple[Command, ...]:
    """Commands for cameras, policy and speed as in ``frame``."""
    cameras = (SetCamera(c.name, frame.camera(c.name)) for c in frame.world.env.cameras)
    return (SetPolicy(frame.world.policy.name), *cameras, SetSpeed(frame.pace.speed))


def step_html(step: Step, number: int, count: int) -> str:
    """A step's text."""
    return (
        f'<div class="mv mv-tour"><div class="dim">{number} of {count}</div>'
        f'<div style="font-size:15px;margin-bottom:4px"><b>{escape(step.title)}</b></div>'
        f"{escape(step.words)}</div>"
    )


def keys_table(keys: Sequence[tuple[str, str]]) -> str:
    """Keys and what they do, as Markdown."""
    rows = [f"| **{key}** | {what} |" for key, what in keys]
    return "\n".join(["| key | what it does |", "|---|---|", *rows])
