"""When an audit has seen enough, and what it then says of every camera.

The problem: an audit of 100 episodes that looks at its results after 25, 50 and 75, and stops as
soon as something is significant at 5 %, is wrong 13 times in 100 and not 5. The idea: every look
has a share of the 5 %, and the shares add up to it. Whatever the looks and tests have to do with
each other, all of them together are then wrong at most 5 times in 100:

    looks after     25      50      75      100 episodes
    shares          0.005   0.005   0.005   0.035

At a look there are two tests for each camera: does success change without it, and is it better
alone than no camera at all? McNemar's exact test answers both, and Holm's correction keeps the
share for all of them. A p-value is multiplied by 0.05 over the share of its look, so that 0.05 is
the limit everywhere. With three cameras, 25 episodes and every one of them lost without First
person: 2 x 0.5^25 x 6 x 10, far below 0.05. A look at which even that could not be significant is
left out, and the last look gets its share.

    needed        success falls significantly without it, and is shown to fall by half or more
    used          success falls significantly without it; a loss of half is not shown
    redundant     no significant fall, but alone significantly better than no camera at all
    no use shown  neither

'Shown' is an interval, as narrow as all cameras together allow: of the loss beyond half of what was
there, it must lie above 0. A camera that costs 49 % is therefore called needed in fewer than 5 of
100 audits, and one that costs 60 % is often called used: more episodes would tell.

An audit stops at a look where every camera is settled: its fall is significant, and shown to be
more or less than half; or its change lies within 5 points either way, and it is significantly
better alone than nothing, or that difference lies within 5 points, too.

Everything works on arrays with any number of leading axes: tests simulate a thousand audits at
once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from madviz.measure.formulas import agresti_min, holm, mcnemar, newcombe
from madviz.types import Array

LEVEL = 0.05
"""How often an audit may claim anything that is not so, for its verdicts together."""
EARLY_SHARE = 0.005
"""The part of ``LEVEL`` that an early look may spend."""
LOOKS = (0.25, 0.5, 0.75)
"""Early looks, as parts of the planned episodes."""
MARGIN = 0.05
"""A change of success within this either way makes no difference."""
VERDICTS = ("no use shown", "redundant", "used", "needed")
"""In the order of their codes."""


@dataclass(frozen=True)
class Look:
    """A moment at which an audit asks whether it has seen enough."""

    episodes: int
    share: float
    """The part of ``LEVEL`` that this look may spend."""

    def confidence(self, cameras: int) -> float:
        """The confidence of an interval for each of ``cameras``, so that what is claimed from all
        of them is wrong at most as often as ``share``. A claim rests on one end of its interval,
        and one end misses half as often as either."""
        return 1 - self.share * min(1.0, 2 / cameras)


def looks(episodes: int, cameras: int) -> tuple[Look, ...]:
    """The looks of an audit of ``episodes`` for each condition; the last one is at the end."""
    early = [
        Look(count, EARLY_SHARE)
        for count in dict.fromkeys(round(part * episodes) for part in LOOKS)
        if count < episodes and 2 * 0.5**count * 2 * cameras <= EARLY_SHARE
    ]
    return (*early, Look(episodes, LEVEL - EARLY_SHARE * len(early)))


@dataclass(frozen=True)
class PairedOutcomes:
    """Success by camera (..., C) and episode n, bool; the same scenes in all four."""

    intact: Array
    """(..., n) with all cameras."""
    removed: Array
    """(..., C, n) without this one."""
    alone: Array
    """(..., C, n) with this one only."""
    floor: Array
    """(..., C, n) with no camera, in the way that ``alone`` leaves the others out."""


@dataclass(frozen=True)
class Judgement:
    """The verdict on every camera, and what it rests on; arrays (..., C)."""

    verdict: Array
    """Codes, places in ``VERDICTS``."""
    settled: Array
    """bool: more episodes are not worth their time."""
    change: tuple[Array, Array]
    """The interval (low, high) of the change without the camera that holds for all cameras and
    looks together."""
    p_removed: Array
    """p-value of the change without the camera, corrected for all tests and looks; significant up
    to ``LEVEL``."""
    p_alone: Array
    """p-value of the difference between this camera alone and none, likewise."""


def judged(outcomes: PairedOutcomes, look: Look) -> Judgement:
    """The verdict of every camera at ``look``, from the ``outcomes`` of the episodes up to it."""
    removed = outcomes.removed
    intact = np.broadcast_to(outcomes.intact[..., None, :], removed.shape)
    fall = table(intact, removed)
    gain = table(outcomes.alone, outcomes.floor)
    p = np.stack([mcnemar(t[1], t[2]) for t in (fall, gain)], -1)
    flat = holm(p.reshape(*p.shape[:-2], -1)).reshape(p.shape)
    flat = np.minimum(flat * (LEVEL / look.share), 1.0)
    falls = (flat[..., 0] <= LEVEL) & (fall[1] > fall[2])
    gains = (flat[..., 1] <= LEVEL) & (gain[1] > gain[2])
    confidence = look.confidence(removed.shape[-2])
    # Above 0 where more than half is lost, below where less.
    low, high = agresti_min(0.5 * intact - removed, confidence)
    verdict = np.where(falls & (low > 0), 3, np.where(falls, 2, np.where(gains, 1, 0)))
    change = newcombe(*table(removed, intact), confidence)
    gained = newcombe(*gain, confidence)
    settled = np.where(falls, (low > 0) | (high < 0), within(change) & (gains | within(gained)))
    return Judgement(verdict, settled, change, flat[..., 0], flat[..., 1])


def table(first: Array, second: Array) -> tuple[Array, Array, Array, Array]:
    """(..., n) bool twice -> counts (...) of both, first only, second only, neither."""
    return (
        (first & second).sum(-1),
        (first & ~second).sum(-1),
        (~first & second).sum(-1),
        (~first & ~second).sum(-1),
    )


def within(interval: tuple[Array, Array]) -> Array:
    """True where the interval (low, high) of a difference lies within ``MARGIN`` of 0."""
    low, high = interval
    return (low >= -MARGIN) & (high <= MARGIN)
