"""The words that end an episode in which a camera was changed, and every comparison.

    First person was dropped at step 15. MAD drove the nail in, Merged Only did not. MAD's hand was
    up to 0.6 cm from its path with all cameras; Merged Only's up to 12.3 cm, and 1 cm for the first
    time at step 23. Without it from the start, over 100 episodes: MAD 1.00 [0.96, 1.00] and
    Merged Only 0.00 [0.00, 0.04].

They say what was done, who succeeded, what came of it, and what was measured. Page, film and
lessons have them from here; the site says the same in ``site/web/ending.js``, and one table of
cases tests both. So it is with ``needs_words``, what success without each camera comes to.
``guard_words`` is the page's alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from madviz.agent.methods import label_of
from madviz.envs.tasks import done_words
from madviz.measure.statistics import Paired, SuccessRate
from madviz.observation.condition import Condition
from madviz.session.frame import Deed, Frame, HandPaths, Outcome
from madviz.types import PolicySpec

RateOf = Callable[[PolicySpec, Condition], SuccessRate]
"""The rate that is known of a policy under a condition; its n is 0 where none is."""


@dataclass(frozen=True)
class EndedSide:
    """A policy at the end of its episode."""

    label: str
    success: bool
    rate: SuccessRate
    """Measured with the cameras as they were at the last decision."""
    deeds: tuple[Deed, ...] = ()
    departure: tuple[float, int | None] | None = None
    """``HandPaths.largest`` and ``differ_at``; None where they are not known."""


@dataclass(frozen=True)
class Ending:
    """The four parts of the words; each may be empty."""

    done: str
    """The changes of cameras."""
    result: str
    """Who succeeded."""
    measured: str
    winners: tuple[str, ...] = ()
    """The labels of those who succeeded."""
    came_of_it: str = ""
    """The distance of the hand from its path with all cameras."""

    def __str__(self) -> str:
        parts = (self.done, self.result, self.came_of_it, self.measured)
        return " ".join(filter(None, parts))


def ending_of(frame: Frame, rate_of: RateOf) -> Ending | None:
    """The words for an episode that is over, where something was changed or compared."""
    if not frame.ended or frame.past or not frame.world.outcomes:
        return None
    sides = [frame.world, *([frame.second.world] if frame.second is not None else [])]
    if any(not (side.outcomes and side.last) for side in sides):
        return None
    outcomes = [side.outcomes[-1] for side in sides]
    if len(outcomes) == 1 and not outcomes[0].deeds:
        return None
    labels = side_labels([outcome.policy for outcome in outcomes])
    paths = [frame.paths, frame.second.paths if frame.second is not None else None]
    ended = [_side(*side, rate_of) for side in zip(labels, outcomes, paths, strict=False)]
    return ending(ended, done_words(frame.world.env.task))


def side_labels(policies: Sequence[PolicySpec]) -> list[str]:
    """The names of the sides in sentences: their policies', or A and B where those are the same."""
    labels = [label_of(policy) for policy in policies]
    return labels if len(set(labels)) == len(labels) else ["A", "B"]


def _side(label: str, outcome: Outcome, paths: HandPaths | None, rate_of: RateOf) -> EndedSide:
    rate = rate_of(outcome.policy, outcome.last or Condition("all"))
    label = label if outcome.alone else f"{label} (it acted last)"
    departure = (paths.largest, paths.differ_at) if paths is not None else None
    return EndedSide(label, outcome.success, rate, outcome.deeds, departure)


def ending(sides: Sequence[EndedSide], done: tuple[str, str]) -> Ending:
    """The words for one side or two; ``done`` as in ``envs/tasks.py:DONE``."""
    winners = tuple(side.label for side in sides if side.success)
    return Ending(
        _what_was_done(sides),
        _who_succeeded(sides, done),
        _what_was_measured(sides),
        winners,
        _what_came_of_it(sides),
    )


BOTH = "both"
NEITHER = "neither"
YES_OR_NO = ("yes", "no")
"""The answers to the question whether the only policy will succeed."""


def guess_words(guess: str, winners: Sequence[str]) -> str:
    """``You said both, and it was MAD alone.`` A guess is a label, ``BOTH``, ``NEITHER``, or
    one of ``YES_OR_NO``."""
    if guess in YES_OR_NO:
        right = (guess == "yes") == bool(winners)
        came = "it did" if winners else "it did not"
        return f"You said {guess}, and so it was." if right else f"You said {guess}, but {came}."
    if list(winners) == [guess] or guess == {0: NEITHER, 2: BOTH}.get(len(winners)):
        return f"You said {guess}, and so it was."
    came = {0: NEITHER, 2: BOTH}.get(len(winners), f"{next(iter(winners), '')} alone")
    return f"You said {guess}, and it was {came}."


def needs_words(label: str, all_cameras: SuccessRate, without: Mapping[str, SuccessRate]) -> str:
    """``Merged Only needs First person: without it, 0.00 [0.00, 0.04] n=100.`` ``without``: a rate
    for each of three cameras or more, by its label. A camera is needed where the interval lies
    below half of the success with all, whatever that is within its own interval; that none is
    needed is said where every interval lies above it. '' where neither is decided."""
    low, high = (end / 2 for end in all_cameras.interval)
    if len(without) < 3 or not all(rate.n for rate in (all_cameras, *without.values())):
        return ""
    needed = {camera: rate for camera, rate in without.items() if rate.interval[1] < low}
    if needed:
        rates = _listed([str(rate) for rate in needed.values()])
        return f"{label} needs {_listed(list(needed))}: without it, {rates}."
    if any(rate.interval[0] <= high for rate in without.values()):
        return ""
    worst = min(without.values(), key=lambda rate: rate.value)
    lowest = str(worst)
    return f"{label} needs no single camera: without any one, at least {lowest}."


def guard_words(pair: Paired) -> str:
    """``The guard helps: 0.95 with it, 0.00 without, on the same 20 scenes (+95 points [70, 99]).``
    ``pair``: with the guard first. '' where no scene was played both ways."""
    if pair.n == 0:
        return ""
    guarded, bare = ((pair.both + alone) / pair.n for alone in (pair.first_only, pair.second_only))
    scenes = f"the same {pair.n} scene{'' if pair.n == 1 else 's'}"
    if pair.any_time() > 0.05:
        words = f"With the guard {guarded:.2f}, without {bare:.2f}, on {scenes}"
        return f"{words}: no difference is shown yet."
    low, high = (f"{100 * end:+.0f}" for end in pair.interval())
    points = f"{100 * pair.difference:+.0f} points [{low}, {high}]"
    verb = "helps" if pair.difference > 0 else "costs success"
    return f"The guard {verb}: {guarded:.2f} with it, {bare:.2f} without, on {scenes} ({points})."


def _what_was_done(sides: Sequence[EndedSide]) -> str:
    if len({side.deeds for side in sides}) == 1:
        return f"{_deeds(sides[0].deeds)}." if sides[0].deeds else ""
    parts = [f"{side.label}: {_deeds(side.deeds) or 'all cameras intact'}" for side in sides]
    return f"{'; '.join(parts)}."


def _deeds(deeds: Sequence[Deed]) -> str:
    return _listed([f"{deed.label} {deed.past} {_when(deed)}" for deed in deeds])


def _when(deed: Deed) -> str:
    if deed.step is None:
        return "for a while"
    if deed.step == 0:
        return "from the start"
    return f"{'at' if deed.past == 'was dropped' else 'from'} step {deed.step}"


def _listed(parts: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join([", ".join(parts[:-1])] * (len(parts) > 1) + list(parts[-1:]))


def _who_succeeded(sides: Sequence[EndedSide], done: tuple[str, str]) -> str:
    base, past = done
    labels = [side.label for side in sides]
    if len(sides) == 1:
        return f"{labels[0]} {past}." if sides[0].success else f"{labels[0]} did not {base}."
    first, second = (side.success for side in sides)
    if first and second:
        return f"{labels[0]} and {labels[1]} both {past}."
    if not first and not second:
        return f"Neither {labels[0]} nor {labels[1]} {past}."
    winner, loser = labels if first else labels[::-1]
    return f"{winner} {past}, {loser} did not."


def _what_came_of_it(sides: Sequence[EndedSide]) -> str:
    """``MAD's hand was up to 12.3 cm from its path with all cameras, and 1 cm for the first time at
    step 23.``"""
    parts = []
    for side in sides:
        if side.departure is None:
            continue
        largest, step = side.departure
        first = "" if step is None else f", and 1 cm for the first time at step {step}"
        hand = "'s" if parts else "'s hand was"
        reference = "" if parts else " from its path with all cameras"
        far = "less than 0.1" if largest < 0.001 else f"up to {100 * largest:.1f}"
        parts.append(f"{side.label}{hand} {far} cm{reference}{first}")
    return f"{'; '.join(parts)}." if parts else ""


def _what_was_measured(sides: Sequence[EndedSide]) -> str:
    rates = [side.rate for side in sides]
    counts = {rate.n for rate in rates}
    if counts == {0}:
        return "How often that happens is not measured yet."
    lead = _lead(sides)
    if len(counts) == 1:
        over = f"{lead}, over" if lead else "Over"
        measured = [rate.without_count for rate in rates]
        return f"{over} {counts.pop()} episodes: {_listed(_named(sides, measured))}."
    measured = [f"{r.without_count} (n = {r.n})" if r.n else "not measured" for r in rates]
    return f"{lead or 'Measured'}: {_listed(_named(sides, measured))}."


def _named(sides: Sequence[EndedSide], said: list[str]) -> list[str]:
    """``MAD 1.00 [0.96, 1.00]`` for each of two sides; one needs no name."""
    if len(sides) == 1:
        return said
    return [f"{side.label} {words}" for side, words in zip(sides, said, strict=True)]


def _lead(sides: Sequence[EndedSide]) -> str:
    """The condition that was measured, where it did not hold all the time."""
    deeds = sides[0].deeds
    alike = len({side.deeds for side in sides}) == 1
    if all(deed.step == 0 for side in sides for deed in side.deeds):
        return ""
    if alike and len(deeds) == 1 and deeds[0].past == "was dropped" and deeds[0].step is not None:
        return "Without it from the start"
    return "With the cameras as at the end, from the start"
