"""Does a change help? Episodes decide, on the same scenes as with the file as it is.

A scene is won where only the change succeeds, and lost where only the file as it is does. A change
helps where it wins six scenes before it loses one, of ten at most. If it made no difference, a
scene that comes out differently would be won as often as lost, and six wins in a row without a loss
would come once in 2^6 = 64. Three changes are played at most, so advice is false at most 3 in 64
times, however the distances chose them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

MOST_SCENES = 10
ENOUGH = 6
"""Wins before the first loss; also the least scenes of the file as it is."""
Played = Callable[[int], bool]
"""From the number of a scene to whether its episode succeeded."""
Verdict = Literal["helps", "no better", "cannot tell"]


@dataclass(frozen=True)
class Comparison:
    """The scenes of one change beside those of the file as it is."""

    successes: int
    """The outcomes of the change."""
    before: int
    """The outcomes of the file as it is, on the same scenes."""
    n: int
    wins: int
    losses: int

    @property
    def verdict(self) -> Verdict:
        """See the module."""
        if self.wins >= ENOUGH and not self.losses:
            return "helps"
        always = self.before == self.successes == self.n  # Nothing is left to win.
        return "cannot tell" if self.wins > self.losses or always else "no better"


def compared(as_wired: Played, changed: Played) -> Comparison:
    """Plays scene after scene until a loss, enough wins, or too few scenes for them are left."""
    pairs: list[tuple[bool, bool]] = []
    for scene in range(MOST_SCENES):
        pairs.append((as_wired(scene), changed(scene)))
        wins = pairs.count((False, True))
        losses = pairs.count((True, False))
        if losses or wins == ENOUGH or wins + MOST_SCENES - len(pairs) < ENOUGH:
            break
    before, after = (sum(outcomes) for outcomes in zip(*pairs, strict=True))
    return Comparison(successes=after, before=before, n=len(pairs), wins=wins, losses=losses)
