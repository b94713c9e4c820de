"""Who acts, how fast, and how the episode stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
import viser

from madviz.agent.methods import METHODS, label_of
from madviz.app.markup import error_html, progress_bar
from madviz.app.panel import Assign, Send
from madviz.app.panels.subsets import action_bars
from madviz.app.toolkit import Cell, Choice, HtmlPanel, SyncedInput, on_use, place
from madviz.drawing.colours import BAD, GOOD, MUTED, NOTE
from madviz.policies.checkpoint import shown
from madviz.policies.guarded import unguarded
from madviz.policies.no_policy import NO_POLICY
from madviz.recorded.known import LABEL, is_recording
from madviz.session.commands import (
    Command,
    Pause,
    Play,
    Reset,
    SetAutoNext,
    SetPolicy,
    SetSeed,
    SetSpeed,
    StepOnce,
)
from madviz.session.frame import Frame
from madviz.types import PolicySpec

SPEEDS: dict[str, float | None] = {"1": 1.0, "5": 5.0, "10": 10.0, "20": 20.0, "max": None}
RUNS: dict[str, Command] = {
    "play": Play(),
    "pause": Pause(),
    "step": StepOnce(),
    "again": Reset(),
    "next": Reset(next_seed=True),
}


@dataclass(frozen=True)
class PolicyChoice:
    """A policy that can be picked."""

    name: str
    """The name by which ``load_policy`` finds it."""
    label: str
    """The label among policies of the same task."""
    task: str = ""
    """'' where that is not known."""
    broken: bool = False
    """Whether the label says what is wrong with it."""


def offered(choices: Sequence[PolicyChoice], task: str) -> dict[str, str]:
    """Names of policies by what they are called on a page: those of ``task``, and those of which
    no task is known."""
    return {one.label: one.name for one in choices if one.task in (task, "")}


class PolicyPicker:
    """A dropdown of policies that follows the one that acts."""

    def __init__(
        self,
        gui: viser.GuiApi,
        label: str,
        names: dict[str, str],
        frame: Frame,
        hint: str,
    ) -> None:
        """``names`` by what they are called, as from ``offered``; it begins with the policy of
        ``frame``, or with the first where that one is not among them."""
        self.names = names
        self._labels = {name: label for label, name in names.items()}
        current = self._labels.get(unguarded(frame.world.reference), next(iter(names)))
        self.handle = gui.add_dropdown(label, list(names), initial_value=current, hint=hint)
        self._shown = SyncedInput(self.handle)

    def show(self, frame: Frame, force: bool = False) -> list[Assign]:
        """The change by which it names the policy of ``frame``; ``force`` as in ``SyncedInput``."""
        name = unguarded(frame.world.reference)
        return self._shown.show(self._labels.get(name) or shown(name), force)


class PolicyPanel(HtmlPanel):
    """Picker, transport, and the state of the episode. ``send`` None: read-only."""

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Send | None,
        frame: Frame,
        choices: Sequence[PolicyChoice],
    ) -> None:
        task = frame.world.env.task
        names = offered(choices, task)
        current = unguarded(frame.world.reference)
        if current not in names.values():
            names = {shown(current): current, **names}
        self._tasks: dict[str, str] = {}
        """Each with the first policy for it."""
        for one in choices:
            self._tasks.setdefault(one.task or task, one.name)
        self._run: Choice | None = None
        self._speed: Choice | None = None
        if send is not None:
            self._add_controls(gui, send, frame, names)
        self._style = gui.add_html("")
        self.handles = [*self.handles, self._style]
        super().__init__(gui, frame, status_html)

    def _add_controls(
        self, gui: viser.GuiApi, send: Send, frame: Frame, names: dict[str, str]
    ) -> None:
        tasks = list({frame.world.env.task: "", **self._tasks})
        self._task = gui.add_dropdown(
            "Task",
            sorted(tasks),
            initial_value=frame.world.env.task,
            hint="Another task, with the first of its policies.",
            visible=len(tasks) > 1,
        )
        on_use(self._task, lambda _, task: send(SetPolicy(self._tasks[task])))
        self._shown_task = SyncedInput(self._task)
        hint = "Swap the policy in mid-episode."
        self._picker = PolicyPicker(gui, "Policy", names, frame, hint)
        on_use(self._picker.handle, lambda _, label: send(SetPolicy(names[label])))
        labels = {name: name for name in RUNS} | {"play": "▶ play"}
        hint = "Space, S, R and N do it, too."
        self._run = Choice(gui, "Episode", labels, lambda _, name: send(RUNS[name]), hint)
        self._speed = Choice(
            gui,
            "Speed",
            {name: name for name in SPEEDS},
            lambda _, name: send(SetSpeed(SPEEDS[name])),
            "Decisions per second that are asked for; max is as fast as it goes.",
        )
        seed = gui.add_number(
            "Number" if frame.world.recorded else "Seed",
            frame.world.seed,
            min=0,
            max=2**31 - 1,
            step=1,
            hint="Which episode to start.",
        )
        self._shown_seed = SyncedInput(seed)
        go = gui.add_button("go", hint="Start the episode of this seed.")
        on_use(go, lambda *_: send(SetSeed(int(seed.value))))
        auto = gui.add_checkbox(
            "Auto", True, hint="Start the next seed by itself when an episode is over."
        )
        self._shown_auto = SyncedInput(auto)
        on_use(auto, lambda _, on: send(SetAutoNext(bool(on))))
        cells = [
            Cell(self._task, 1, 8),
            Cell(self._picker.handle, 1, 8),
            Cell(self._run.handle, 1, 8),
            Cell(self._speed.handle, 1, 8),
            Cell(seed, 1, 4),
            Cell(go, 5, 2),
            Cell(auto, 7, 2, "2.8em"),
        ]
        self.handles = place(gui, "run", 8, cells)

    def update(self, frame: Frame) -> list[Assign]:
        changes = super().update(frame)
        if self._run is None or self._speed is None:
            return changes
        speed = next((name for name, rate in SPEEDS.items() if rate == frame.pace.speed), "")
        marks = self._run.style("pause" if frame.pace.phase == "paused" else "play")
        marks += self._speed.style(speed)
        changes.append(Assign(self._style, "content", f"<style>{marks}</style>"))
        changes += self._shown_auto.show(frame.pace.auto_next)
        changes += self._shown_seed.show(frame.world.seed)
        # After an error the policy may be another than the one that was picked.
        failed = bool(frame.pace.error)
        changes += self._shown_task.show(frame.world.env.task, force=failed)
        return changes + self._picker.show(frame, force=failed)


def policy_words(spec: PolicySpec) -> str:
    """The kind of policy, for somebody who never heard of it."""
    if spec.method == NO_POLICY:
        return "No policy: the recording alone."
    if spec.method in METHODS and is_recording(spec.task):
        return f"{label_of(spec)}, trained on recordings."
    if spec.method in METHODS:
        return METHODS[spec.method].page_words
    return f"Method {spec.method}, recipe {spec.recipe}."


def purpose(method: str, setting: str, recipe: str) -> str:
    """The label of a policy in a list of those of one task."""
    words = METHODS[method].page_words.rstrip(".") if method in METHODS else method
    more = [word for word in (setting, recipe) if word not in ("three", "light")]
    return f"{words} ({', '.join(more)})" if more else words


def verdict(frame: Frame) -> tuple[str, str]:
    """The state of the episode in a word, and the colour of its tag."""
    if frame.pace.error:
        return "STOPPED", NOTE
    if frame.past:
        return "LOOKING BACK", NOTE
    if frame.ended and frame.world.recorded:
        return "END", NOTE
    if frame.ended:
        return ("SUCCESS", GOOD) if frame.world.success else ("FAIL", BAD)
    return ("PAUSED", MUTED) if frame.pace.phase == "paused" else ("RUNNING", "#dfe3e8")


def status_html(frame: Frame) -> str:
    """The episode at a glance. The attributes are there for those who measure the page."""
    attributes = (
        f'data-episode="{frame.world.episode}" data-step="{frame.world.step}" '
        f'data-phase="{frame.pace.phase}" data-setting="{escape(str(frame.condition))}"'
    )
    recorded = frame.world.recorded
    which = f"{'number' if recorded else 'seed'} {frame.world.seed}"
    if recorded and recorded.episode != frame.world.seed:
        which += f": episode {recorded.episode}"
    seed = f'<span class="plain num" style="float:right">{which}</span>'
    goal = recorded_html(frame) if recorded else _goal(frame)
    return (
        f'<div class="mv mv-status" {attributes}>'
        f'<div class="dim" style="font-size:12px">{escape(policy_words(frame.world.policy))}</div>'
        f"{_progress(frame)}{goal}<h4>{seed}{_heading(frame)}</h4>"
        '<div class="mv-action" style="display:flex;gap:8px;align-items:center">'
        f'<div style="flex:1">{_action(frame)}</div>{_value(frame)}</div>'
        f"{_planned(frame)}{_error(frame)}</div>"
    )


def _has_critic(frame: Frame) -> bool:
    """Whether the policy forecasts anything, on whichever set of cameras was read."""
    return bool(np.isfinite(frame.world.probe.readout.q).any())


def _heading(frame: Frame) -> str:
    if frame.world.policy.method == NO_POLICY:
        return "Recorded action"
    return "Action and its value Q" if _has_critic(frame) else "Action"


def _value(frame: Frame) -> str:
    """Q of the present set; nothing where the policy has no critic."""
    if not _has_critic(frame):
        return ""
    value = f"{frame.q:.1f}" if np.isfinite(frame.q) else "–"
    return f'<span class="num">Q <b>{value}</b></span>'


def _planned(frame: Frame) -> str:
    """For a policy that takes several decisions from one look."""
    if frame.world.policy.chunk == 1:
        return ""
    left = frame.world.planned
    when = f"after {left} more decisions" if left else "now"
    return (
        f'<div class="dim">Acts in chunks of up to {frame.world.policy.chunk} decisions: it looks '
        f"again {when}. Above: what it would do if it looked now.</div>"
    )


def _progress(frame: Frame) -> str:
    """The verdict, how far the episode is, the pace, and a bar."""
    word, colour = verdict(frame)
    big = f"background:{colour};font-size:15px;padding:1px 9px"
    return (
        '<div style="margin-top:6px;display:flex;gap:8px;align-items:center;white-space:nowrap">'
        f'<span class="tag mv-verdict" style="{big}">{word}</span>'
        f'<span class="num">step <b>{frame.world.step}</b>/{frame.decisions}</span>'
        f'<span class="num" style="margin-left:auto">{_pace(frame)}</span></div>'
        f"{progress_bar(frame.world.step / frame.decisions, colour)}"
    )


def _goal(frame: Frame) -> str:
    """Whether the goal is met, and below it what the goal is: on at most two lines."""
    met = "✔ Goal met now" if frame.world.success else "✘ Goal not met now"
    ever = (
        "" if frame.world.success else ", but it was" if frame.world.success_any else ", nor before"
    )
    goal = escape(frame.world.env.success)
    return f'<div>{met}{ever}</div><div class="dim two-lines" title="{goal}">Goal: {goal}</div>'


def recorded_html(frame: Frame) -> str:
    """The label of all recordings, and the episode's task."""
    task = escape(frame.world.recorded.task if frame.world.recorded else "")
    return (
        f'<div class="mv-recorded"><b style="color:{NOTE}">{LABEL}</b></div>'
        f'<div class="dim two-lines" title="{task}">Task: {task}</div>'
    )


def _action(frame: Frame) -> str:
    if frame.world.policy.method == NO_POLICY and frame.world.recorded:
        return action_bars(np.clip(frame.world.recorded.action, -1, 1))
    if np.isfinite(frame.action).all():
        return action_bars(frame.action)
    if frame.world.probe.waiting[frame.row]:
        return '<span class="dim">the policy has not answered yet</span>'
    return f'<span style="color:{NOTE}">not a number, or this policy cannot act on that</span>'


def _pace(frame: Frame) -> str:
    rate = frame.pace.rate
    if frame.pace.phase != "playing" or not np.isfinite(rate):
        return ""
    if not frame.behind:
        return f"{rate:.1f}/s"
    title = "Steps a second; this machine cannot do more now."
    return f'<b style="color:{NOTE}" title="{title}">{rate:.1f} of {frame.pace.speed:g}/s</b>'


def _error(frame: Frame) -> str:
    if not frame.pace.error:
        return ""
    again = "Press again to restart the episode, or play to try once more."
    return f'<div class="mv-error boxed">{error_html("Paused: ", frame.pace.error, again)}</div>'
