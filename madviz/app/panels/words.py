"""The line under the pictures: what a visitor has just changed, and how the episode ended."""

from __future__ import annotations

from html import escape

import viser

from madviz.app.success_rates import SuccessRates
from madviz.app.toolkit import HtmlPanel
from madviz.drawing.colours import NOTE
from madviz.session.ending import Ending, ending_of, guess_words
from madviz.session.frame import Change, Frame, deed, words
from madviz.session.guard_words import guard_sentence
from madviz.types import PolicySpec

WAITS = "Waiting for the policy: {:.0f} s. What you change now counts from its next decision on."


class WordsPanel(HtmlPanel):
    """See the module."""

    HINT = (
        "Take a camera away: press <b>off</b> under its picture, its number key, or click it in "
        "the scene. <b>Off</b> leaves it out; <b>break …</b> lets it send a bad picture."
    )

    def __init__(self, gui: viser.GuiApi, frame: Frame, rates: SuccessRates) -> None:
        self._rates = rates
        self._last: tuple[Change, PolicySpec] | None = None
        self.guess = ""
        """A visitor's guess who will succeed in the comparison; it counts for one episode."""
        self._asked_in: int | None = None
        """The episode that was shown when the guess was made; it is for a later one."""
        self._shown_in: int | None = None
        self._guessed_in: int | None = None
        """The episode in which the guess was compared."""
        super().__init__(gui, frame, self._content)

    def hear(self, guess: str) -> None:
        """A visitor's guess on the next episode."""
        self.guess = guess
        self._asked_in = self._shown_in

    def _content(self, frame: Frame) -> str:
        self._shown_in = frame.world.episode
        if frame.world.change is not None:
            self._last = (frame.world.change, frame.world.policy)
        ending = ending_of(frame, self._rates.best)
        if self._guessed_in not in (None, frame.world.episode):
            self.guess = ""
            self._guessed_in = None
        if ending is not None:
            guess = "" if frame.world.episode == self._asked_in else self.guess
            self._guessed_in = frame.world.episode if guess else None
            said = ending_html(ending, frame, guess)
        elif frame.pace.waited >= 1:
            said = escape(WAITS.format(frame.pace.waited))
        elif self._last is None or self._last[1] != frame.world.policy:
            said = f'<span class="dim">{self.HINT}</span>'
        else:
            said = escape(both_sides(self._last[0], frame, self._rates))
        for side in (frame, frame.second):
            if side is not None and (noticed := guard_sentence(side)):
                said += f'<div class="mv-noticed" role="status">{escape(noticed)}</div>'
        return (
            f'<div class="mv mv-words" style="border-left:3px solid {NOTE};margin:0 10px 4px;'
            f'padding:2px 8px;min-height:36px">{said}</div>'
        )


def ending_html(ending: Ending, frame: Frame, guess: str = "") -> str:
    """The three parts of an end, a visitor's guess, and how it goes on."""
    result = f'<b style="color:{NOTE}">{escape(ending.result)}</b>'
    guessed = escape(guess_words(guess, ending.winners)) if guess else ""
    parts = (escape(ending.done), result, guessed, escape(ending.measured))
    goes_on = "" if frame.pace.speed is None or not frame.pace.auto_next else " The next one soon."
    return (
        f'<div class="mv-ending" role="status">{" ".join(filter(None, parts))}'
        f'<span class="dim">{goes_on} R: again. N: the next start.</span></div>'
    )


def both_sides(change: Change, frame: Frame, rates: SuccessRates) -> str:
    """The sentence; where the same was done to B, short, with what came of it on each side."""
    second = frame.second
    other = second.world.change if second is not None else None
    if second is None or other is None or other.camera != change.camera:
        return sentence(change, frame, rates)
    parts = []
    for name, side, done in (("A", frame, change), ("B", second, other)):
        rate = rates.best(side.world.policy, done.condition_after)
        known = f", success measured {rate.value:.2f} (n={rate.n})" if rate.n else ""
        parts.append(f"{name}'s action changed by {done.action_change:.2f}{known}")
    return f"{deed(change, frame.world.env)}: {'; '.join(parts)}"


def sentence(change: Change, frame: Frame, rates: SuccessRates) -> str:
    """``Third A dropped: action changed by 0.31, Q 12.1 → 9.8; success measured 0.94 → 0.81
    (n=16)``."""
    line = words(change, frame.world.env)
    if change.condition_before == change.condition_after:
        return line
    before = rates.best(frame.world.policy, change.condition_before)
    after = rates.best(frame.world.policy, change.condition_after)
    if not after.n:
        tail = f"success measured {before.value:.2f} → not measured yet" if before.n else ""
    else:
        start = f"{before.value:.2f} → " if before.n else ""
        tail = f"success measured {start}{after.value:.2f} (n={after.n})"
    return f"{line}; {tail}" if tail else line
