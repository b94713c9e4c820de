"""The line under the pictures: what a visitor has just changed, and how the episode ended.

When a camera is dropped, it asks who will still succeed. Nothing waits for the answer, which is
compared with the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import viser

from madviz.app.panel import Assign
from madviz.app.success_rates import SuccessRates
from madviz.app.toolkit import HtmlPanel, heard
from madviz.drawing.colours import NOTE
from madviz.policies.no_policy import NO_POLICY
from madviz.session.ending import (
    BOTH,
    NEITHER,
    YES_OR_NO,
    Ending,
    ending_of,
    guess_words,
    side_labels,
)
from madviz.session.frame import Change, Frame, World, action_words, deed, untouched, words
from madviz.session.guard_words import guard_sentence

ASKS = {1: "Will it still do it?", 2: "Which will still do it?"}
"""The question, by the number of sides."""
SILENCE = "just show me"
LINES = 54
ANSWERS = 30
"""Pixels of three lines of words, and of the row of answers; it has its place before it is there,
so that nothing under it moves."""
WAITS = "Waiting for the policy: {:.0f} s. What you change now counts from its next decision on."


@dataclass
class Prediction:
    """A visitor's guess who will succeed."""

    guess: str = ""
    episode: int | None = None
    """The episode for which it counts; None: the next one that ends after ``asked_in``."""
    asked_in: int | None = None
    """The episode that ran when it was asked for a later one."""
    silent: bool = False
    """True after *just show me*: no more questions in this visit."""

    def take(self, answer: str, episode: int | None = None, asked_in: int | None = None) -> None:
        """Notes an answer; ``SILENCE`` is none, and the last question."""
        self.silent |= answer == SILENCE
        self.guess = "" if answer == SILENCE else answer
        self.episode = episode
        self.asked_in = asked_in

    def about(self, episode: int) -> str:
        """The guess on an episode that is over; from now on it counts for no other."""
        if episode == self.asked_in:
            return ""
        self.episode = episode
        return self.guess


class WordsPanel(HtmlPanel):
    """See the module."""

    HINT = (
        "Take a camera away: press <b>off</b> under its picture, its number key, or click it in "
        "the scene. <b>Off</b> leaves it out; <b>break …</b> lets it send a bad picture."
    )

    def __init__(
        self,
        gui: viser.GuiApi,
        frame: Frame,
        rates: SuccessRates,
        prediction: Prediction | None = None,
    ) -> None:
        """``prediction`` None: nothing is asked."""
        self._rates = rates
        self._frame = frame
        self._last: tuple[Change, World] | None = None
        """The newest change, and where it happened, as long as it holds."""
        self._prediction = prediction or Prediction(silent=True)
        super().__init__(gui, frame, self._content)
        self._answers = gui.add_button_group("Your guess", YES_OR_NO, visible=False)
        self._answers.on_click(heard(lambda event: self._answer(event.target.value)))
        self.handles = [*self.handles, self._answers]

    def _answer(self, answer: str) -> None:
        self._prediction.take(answer, self._frame.world.episode)
        self.show(self.update(self._frame))

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        changes = super().update(frame)
        asks = asks_now(frame, self._prediction)
        options = (*answers(frame), SILENCE)
        if asks and tuple(self._answers.options) != options:
            changes.append(Assign(self._answers, "options", options))
        return [*changes, Assign(self._answers, "visible", asks)]

    def _content(self, frame: Frame) -> str:
        if frame.world.change is not None:
            self._last = (frame.world.change, frame.world)
        elif self._last is not None and not holds(*self._last, frame):
            self._last = None
        simulated = frame.world.recorded is None
        ending = ending_of(frame, self._rates.best) if simulated else None
        prediction = self._prediction
        if prediction.episode not in (None, frame.world.episode):
            prediction.take("")
        if ending is not None:
            guess = prediction.about(frame.world.episode)
            said = ending_html(ending, frame, guess if guess in answers(frame) else "")
        elif frame.pace.waited >= 1:
            said = escape(WAITS.format(frame.pace.waited))
        elif self._last is None:
            said = f'<span class="dim">{self.HINT}</span>'
        else:
            said = escape(both_sides(self._last[0], frame, self._rates))
            if asks_now(frame, prediction):
                said += f". <b>{ASKS[1 if frame.second is None else 2]}</b>"
            elif prediction.guess in answers(frame):
                said += f". <b>You say {escape(prediction.guess)}.</b>"
        sides = [frame] if frame.second is None else [frame, frame.second]
        for noticed in dict.fromkeys(map(guard_sentence, sides)):  # Once where both notice alike.
            if noticed:
                said += f'<div class="mv-noticed" role="status">{escape(noticed)}</div>'
        free = 0 if prediction.silent or asks_now(frame, prediction) else ANSWERS
        return (
            f'<div class="mv mv-words" style="border-left:3px solid {NOTE};margin:0 10px 4px;'
            f'padding:2px 8px;min-height:{LINES + free}px">{said}</div>'
        )


def answers(frame: Frame) -> tuple[str, ...]:
    """The answers to the question who will succeed."""
    if frame.second is None:
        return YES_OR_NO
    return (*side_labels([frame.world.policy, frame.second.world.policy]), BOTH, NEITHER)


def holds(change: Change, then: World, frame: Frame) -> bool:
    """True where ``change``, which happened in ``then``, is still so: the same policy acts, and the
    camera is as it left it, which in another episode is worth a word only if it is not intact."""
    name = change.camera
    at = frame.camera(name)
    place = frame.world.ablation.moves.get(name)
    intact = at == untouched(frame.world.policy) and place is None
    return (
        frame.world.policy == then.policy
        and (at, place) == (change.after, then.ablation.moves.get(name))
        and not (intact and frame.world.episode != then.episode)
    )


def asks_now(frame: Frame, prediction: Prediction) -> bool:
    """True where a camera has just been dropped, and the visitor has not answered yet: an answer on
    two policies is none on one."""
    change = frame.world.change
    dropped = change is not None and frame.camera(change.camera).input == "off"
    over = frame.ended or frame.past
    return (
        frame.world.recorded is None
        and dropped
        and not over
        and not prediction.silent
        and prediction.guess not in answers(frame)
    )


def ending_html(ending: Ending, frame: Frame, guess: str = "") -> str:
    """The four parts of an end, a visitor's guess, and how it goes on."""
    result = f'<b style="color:{NOTE}">{escape(ending.result)}</b>'
    guessed = escape(guess_words(guess, ending.winners)) if guess else ""
    came_of_it = escape(ending.came_of_it)
    if came_of_it:
        thick = "Thick line: its path" if frame.second is None else "Yellow: A's path; violet: B's"
        came_of_it += f'<span class="dim"> {thick}; thin: with all cameras.</span>'
    parts = (escape(ending.done), result, guessed, came_of_it, escape(ending.measured))
    goes_on = (
        ""
        if frame.pace.speed is None or not frame.pace.auto_next or frame.pace.phase == "paused"
        else " The next one soon; pause keeps this one."
    )
    return (
        f'<div class="mv-ending" role="status">{" ".join(filter(None, parts))}'
        f'<span class="dim">{goes_on}<span class="mv-keys"> R: again. N: the next start.</span>'
        "</span></div>"
    )


def both_sides(change: Change, frame: Frame, rates: SuccessRates) -> str:
    """The sentence; where the same was done to B, short, with what came of it on each side."""
    second = frame.second
    other = second.world.change if second is not None else None
    if second is None or other is None or not (frame.linked and _alike(other, change)):
        return sentence(change, frame, rates)
    parts = []
    for name, side, done in (("A", frame, change), ("B", second, other)):
        rate = rates.best(side.world.policy, done.condition_after)
        known = f", success measured {rate.value:.2f} (n={rate.n})" if rate.n else ""
        parts.append(f"{action_words(done, name)}{known}")
    return f"{deed(change, frame.world.env)}: {'; '.join(parts)}"


def _alike(one: Change, other: Change) -> bool:
    """True where the same was done to the same camera."""
    return (one.camera, one.after, one.moved) == (other.camera, other.after, other.moved)


def sentence(change: Change, frame: Frame, rates: SuccessRates) -> str:
    """``Third A dropped: action changed by 0.31, Q 12.1 → 9.8; success measured 0.94 → 0.81
    (n=16)``."""
    if frame.world.policy.method == NO_POLICY:
        return f"{deed(change, frame.world.env)}."
    line = words(change, frame.world.env)
    if frame.world.recorded is not None:
        return line
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
