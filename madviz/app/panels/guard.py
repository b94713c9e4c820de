"""The switch *Guard*: a camera that fails is noticed and left out (``madviz.guard``)."""

from __future__ import annotations

from html import escape

import viser

from madviz.app.panel import Assign, Send
from madviz.app.toolkit import SyncedInput, WidgetPanel, on_use
from madviz.policies.checkpoint import has_guard, is_folder, shown
from madviz.policies.guarded import fit_command, unguarded, with_guard
from madviz.policies.no_policy import NO_POLICY
from madviz.session.commands import Compare, Link, SetPolicy
from madviz.session.frame import Frame

HINT = (
    "Watches every camera and leaves out one that fails, until it works again. While two policies "
    "are compared and the switches act on both, B gets it too, and the episode begins again."
)


class GuardPanel(WidgetPanel):
    """See the module. ``send`` None: read-only."""

    def __init__(self, gui: viser.GuiApi, send: Send | None, frame: Frame) -> None:
        self._frame = frame
        self._judged = ("", False)
        """The policy that was looked up last, and whether its guard is fitted."""
        self._send = send
        self._switch = gui.add_checkbox("Guard", False, hint=HINT, disabled=send is None)
        self._shown = SyncedInput(self._switch)
        self._note = gui.add_html("")
        self.handles = [self._switch, self._note]
        on_use(self._switch, lambda _, on: self._set(bool(on)))

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        policy = unguarded(frame.world.reference)
        if policy != self._judged[0]:
            self._judged = (policy, has_guard(policy))
        fitted = self._judged[1]
        policed = frame.world.policy.method != NO_POLICY
        note = (
            ""
            if fitted or not policed
            else f'<div class="mv dim">{escape(no_guard(policy, frame.world.policy.task))}</div>'
        )
        return [
            *self._shown.show(frame.world.guard is not None),
            Assign(self._switch, "visible", policed),
            Assign(self._switch, "disabled", self._send is None or not fitted),
            Assign(self._note, "content", note),
        ]

    def _set(self, on: bool) -> None:
        frame = self._frame
        if self._send is None:
            return
        self._send(SetPolicy(self._reference(frame, on)))
        second = frame.second
        if second is not None and frame.linked:
            self._send(Compare(self._reference(second, on), second.world.ablation))
            self._send(Link(True))

    def _reference(self, frame: Frame, on: bool) -> str:
        policy = unguarded(frame.world.reference)
        return with_guard(policy, on and has_guard(policy))


def no_guard(policy: str, task: str) -> str:
    """The sentence on a policy of ``task`` without a fitted guard."""
    if not is_folder(policy):
        return "On the page, only a policy in a folder can have a guard."
    return f"No guard is fitted for this policy; {fit_command(shown(policy), task)} does it."
