"""A greeting for newcomers, a tour of two minutes, and help for everybody.

A visitor is first offered a comparison: MAD and Merged Only act side by side on the same episode,
and after a few seconds a camera is dropped on both sides; or, where guards are fitted, goes black
without and with a guard. One click leads to it, another past it.

A tour is a list of steps (``tour_steps.py``). Each one says something in plain words and does it on
the page at the same time, with the commands that a visitor's click would send, so that the page
itself is the picture beside the text. However it ends, cameras, policy and pace are as they were
before it, unless a visitor chooses to keep the comparison. Watchers see what the presenter's tour
does, and are not offered one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import viser

from madviz.app.panel import Newest, Send
from madviz.app.panels.policy import PolicyChoice, offered
from madviz.app.toolkit import Cell, guarded, heard, notify, place, theme
from madviz.app.tour_steps import (
    Step,
    acts,
    compares,
    comparison_steps,
    never_alone,
    restored,
    steps,
)
from madviz.policies.checkpoint import has_guard
from madviz.policies.guarded import unguarded
from madviz.session.commands import Command, Play, Scrub, SetPolicy, SetSchedule, SetSpeed
from madviz.session.frame import Frame, NoFrame
from madviz.system.markdown import markdown_table

WIDTH = 300
"""Pixels of the tour's window: at 1280 the scene between the panels has 320."""

COMPARE_BUTTON = "compare"
TOUR_BUTTON = "tour"
HELP_BUTTON = "help, keys"

HINT = (
    "Compare: two policies side by side. Tour: the page, step by step, in two minutes. Help: what "
    "words and keys (?) mean."
)
HELP = """
**What this is.** A robot works at a task. Several cameras watch it; a *policy*, a trained network,
gets their pictures and says how the hand moves next. You may take cameras away while it works.

**off** takes a camera away: nothing of it is added. **break …** breaks it instead: it still sends
pictures, but bad ones (**black**, noise, frozen, blurred, a patch, lossy, late, another light), or
from elsewhere.

**merged** is what the policy acts on: what it makes of each camera's picture, added up.

**Q** is how much reward the policy expects from here on. **action** is how the hand moves next.

**compare** puts two policies side by side, on the same episode and with the same cameras.

**What if?** shows what it would do, at this time step, with every other choice of cameras.

Rest the pointer on a control's name, and it says what it does. Ctrl + K (or ⌘ + K) finds every
command by name.
"""


ALONE = (
    "compare puts a policy beside one that learned with all cameras only. Here, {} has one. "
    "The tab Who wins? compares any two."
)


class Tour:
    """The buttons, the tour's window, and the help."""

    def __init__(
        self,
        client: viser.ClientHandle,
        send: Send | None,
        newest: Newest,
        choices: Sequence[PolicyChoice],
        keys: Sequence[tuple[str, str, Callable[[], None]]],
        guessed: Callable[[str], None] = lambda guess: None,
    ) -> None:
        """``send`` None: a watcher, who gets help only. ``keys`` as in ``Keys.table``. ``guessed``
        hears who a visitor thinks will succeed, or *just show me*."""
        self._client = client
        self._send = send
        self._newest = newest
        self._choices = choices
        self._keys = keys
        self._guessed = guessed
        self._guesses: viser.GuiButtonGroupHandle | None = None
        self._panel: viser.PanelHandle | None = None
        self._help: Any = None
        self._start: Frame | None = None
        """The settings that a step of the tour has changed, as they were before."""
        self._left: Frame | NoFrame | None = None
        """The frame that was shown when the tour ended, and its settings were sent back."""
        self._steps: list[Step] = []
        self._at = 0
        self._acting = ""
        """The policy that the tour has asked for last, or found."""
        gui = client.gui
        frame = newest()
        recorded = isinstance(frame, Frame) and frame.world.env.recorded
        options = (HELP_BUTTON,) if send is None or recorded else (TOUR_BUTTON, HELP_BUTTON)
        if send is not None and isinstance(frame, Frame) and not recorded and self._pairs(frame):
            options = (COMPARE_BUTTON, *options)
        self._row = gui.add_button_group("New?", options, hint=HINT)
        self._row.on_click(heard(lambda event: self._pressed(event.target.value)))

    def _pressed(self, button: str) -> None:
        if button == HELP_BUTTON:
            return self.help()
        # What is offered already is begun, not offered again.
        compared = any(map(compares, self._steps))
        if self._panel is not None and (button == COMPARE_BUTTON) == compared:
            self._panel.expand()
            if compared and self._at == 0:
                self._go()
            return
        # The page still shows what the tour changed, until the simulation has taken it back.
        coming_back = self._panel is not None or self._newest() is self._left
        start = self._start if coming_back else None
        self.end()
        frame = start or self._newest()
        if button == COMPARE_BUTTON and isinstance(frame, Frame) and self._other(frame) is None:
            known = ", ".join(self._pairs(frame))
            notify(self._client, "Choose another policy first", ALONE.format(known))
        elif button == COMPARE_BUTTON:
            self.greet(start)
            self.next()  # Who presses it has asked for it.
        elif button == TOUR_BUTTON:
            self.begin(start)

    def _other(self, frame: Frame | NoFrame | None) -> str | None:
        """The policy to compare with, if there is one."""
        if not isinstance(frame, Frame) or frame.world.env.recorded:
            return None
        return never_alone(frame.world.policy.name, self._choices)

    def _pairs(self, frame: Frame) -> list[str]:
        """The labels of the policies of this task that have one to compare with."""
        here = offered(self._choices, frame.world.env.task)
        return [label for label, name in here.items() if never_alone(name, self._choices)]

    def greet(self, start: Frame | None = None) -> None:
        """Offers the comparison, if there is a policy to compare with. ``start``: the settings that
        are on their way back, where the page shows others."""
        frame = start or self._newest()
        other = self._other(frame)
        if isinstance(frame, Frame) and other is not None:
            first = unguarded(frame.world.reference)
            fitted = has_guard(first) and has_guard(other)
            steps = acts if fitted else comparison_steps
            self._open(frame, steps(frame, other), start)

    def begin(self, start: Frame | None = None) -> None:
        """Opens the tour's window at its first step. ``start`` as in ``greet``."""
        frame = start or self._newest()
        if isinstance(frame, Frame):
            self._open(frame, list(steps(frame, self._choices)), start)

    def _open(self, frame: Frame, steps: list[Step], start: Frame | None) -> None:
        if self._send is None or self._panel is not None:
            return
        self._start = start
        self._steps = steps
        self._at = 0
        self._acting = frame.world.reference
        gui = self._client.gui
        self._panel = gui.add_panel()
        self._panel.float(x=10, y=10, width=WIDTH)
        self._panel.expand()  # On a phone it would begin closed.
        self._tab = self._panel.add_tab("Tour")
        with self._tab:
            # Above the words, whose length differs: a button stays where it was pressed last.
            self._next = gui.add_button("next step", hint="Goes on.")
            self._end = gui.add_button("end the tour", color="gray", hint="All as it was before.")
            place(gui, "tour-steps", 1, [Cell(self._next, 1), Cell(self._end, 1)])
            self._text = gui.add_html("")
        self._next.on_click(heard(lambda _: self._go()))
        self._end.on_click(heard(lambda _: self.end()))
        self._show()

    def _go(self, guess: str = "") -> None:
        """Leads on, by the button or by a ``guess``."""
        step = self._steps[self._at] if self._panel is not None else None
        if step is not None and step.guesses:
            self._guessed(guess or step.go)
        self.next()

    def next(self) -> None:
        """One step on; after the last one the tour is over."""
        if self._panel is None:
            return
        keep = self._steps[self._at].keep
        self._at += 1
        if self._at < len(self._steps):
            self._show()
        else:
            self._start = None if keep else self._start
            self.end()

    def end(self) -> None:
        """Closes the window; cameras, policy, pace and B are as they were."""
        panel = self._panel
        self._panel = None
        if panel is None:
            return
        panel.remove()
        self._left = self._newest()
        if self._start is not None:
            # First to the newest step: a camera that is touched in the past begins another run.
            compared = any(map(compares, self._steps))
            self._do((Play(), *restored(self._start, compared)))

    def _show(self) -> None:
        step = self._steps[self._at]
        count = len(self._steps)
        self._text.content = step_html(step, self._at + 1, count)
        self._next.label = step.go
        self._end.label = step.leave
        self._next.disabled = self._at + 1 == count and not step.keep
        self._ask(step)
        frame = self._newest()
        if isinstance(frame, Frame) and (step.commands or step.back):
            self._start = self._start or frame
        if step.back and isinstance(frame, Frame):
            self._do((Scrub(max(0, frame.world.step - step.back)),))
        self._do(step.commands)

    def _ask(self, step: Step) -> None:
        """The answers that a visitor can give, under the words."""
        if self._guesses is not None:
            self._guesses.remove()
            self._guesses = None
        if step.guesses and self._panel is not None:
            with self._tab:
                self._guesses = self._client.gui.add_button_group("Your guess", step.guesses)
            self._guesses.on_click(heard(lambda event: self._go(event.target.value)))

    def _do(self, commands: Sequence[Command]) -> None:
        send = self._send
        for command in commands:
            if isinstance(command, SetPolicy):
                if self._acts(command.name):  # Loading it again would take a moment.
                    continue
                self._acting = command.name
            if send is not None:
                guarded(self._client, lambda command=command: send(command))

    def _acts(self, policy: str) -> bool:
        """Whether ``policy`` acts, and no other is on its way: what the tour asked for may not have
        come yet, and a visitor may have chosen another."""
        frame = self._newest()
        shown = frame.world.reference if isinstance(frame, Frame) else ""
        return policy == shown == self._acting

    def help(self) -> None:
        """Shows what the words mean, what the keys do, and light or dark."""
        gui = self._client.gui
        if self._help is not None and not self._help.closed:
            self._help.close()  # A browser that shows none of them could ask for thousands.
        modal = self._help = gui.add_modal("Help and keys")
        with modal:
            # Above the words, whose end a low window cuts.
            gui.add_button("close").on_click(heard(lambda _: modal.close()))
            gui.add_markdown(HELP)
            if self._keys:
                rows = [(f"**{key}**", label) for label, key, _ in self._keys]
                gui.add_markdown(markdown_table(("key", "what it does"), rows))
            shade = gui.add_button_group(
                "This page", ("dark", "light"), hint="Only here; other visitors choose theirs."
            )
            shade.on_click(heard(lambda event: theme(gui, event.target.value == "light")))

    def remove(self) -> None:
        """Takes all of it off the page. The simulation stays as it is, but for another task: there,
        failures and pace are those from before the tour."""
        if self._panel is not None:
            frame = self._newest()
            start = self._start
            if start is not None and isinstance(frame, Frame):
                if frame.world.env.task != start.world.env.task:
                    self._do((SetSchedule(start.schedule), SetSpeed(start.pace.speed)))
            self._panel.remove()
            self._panel = None
        self._row.remove()


def step_html(step: Step, number: int, count: int) -> str:
    """A step's text."""
    return (
        f'<div class="mv mv-tour"><div class="dim">{number} of {count}</div>'
        f'<div style="font-size:15px;margin-bottom:4px"><b>{escape(step.title)}</b></div>'
        f"{escape(step.words)}</div>"
    )
