"""Which episodes an audit plays next, and when it has played enough.

First come the conditions that verdicts rest on, from one look (``verdict.py``) to the next, until
all cameras are settled or the planned episodes are played. Then every other condition is played on
the same seeds. Three cameras, 100 episodes planned, seeds from 60000 on:

    what is there                          what is wanted
    nothing                                8 deciding conditions on the seeds 60000 to 60024
    25 of each; not all are settled        the same 8 on 60025 to 60049
    50 of each; all cameras are settled    the 28 others on 60000 to 60049
    50 of all 36                           nothing: the audit is done

An ``AuditPlan`` keeps no outcomes. All it says follows from those that it is shown, so that an
audit goes on after a kill with whatever was stored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from madviz.measure.audit.lost_cameras import INTACT, Cameras
from madviz.measure.audit.verdict import LEVEL, Judgement, Look, PairedOutcomes, judged, looks
from madviz.measure.formulas import detectable
from madviz.observation.condition import Condition
from madviz.types import Array

Outcomes = Mapping[Condition, Mapping[int, bool]]
"""Success at the last step, by seed."""


@dataclass(frozen=True)
class AuditPlan:
    """An audit of at most ``episodes`` for each condition, on the seeds from ``seed`` on."""

    cameras: Cameras
    episodes: int
    seed: int

    @cached_property
    def looks(self) -> tuple[Look, ...]:
        return looks(self.episodes, len(self.cameras.names))

    @cached_property
    def deciding(self) -> tuple[Condition, ...]:
        """The conditions that verdicts rest on, each once."""
        rows = [self.cameras.deciding(name) for name in self.cameras.names]
        removed = [row.removed.condition for row in rows]
        alone = [row.alone.condition for row in rows]
        floors = [row.floor.condition for row in rows]
        return tuple(dict.fromkeys([INTACT, *removed, *alone, *floors]))

    @cached_property
    def every(self) -> tuple[Condition, ...]:
        """All conditions, each once, in the order in which they are played."""
        rows = [row.condition for row in self.cameras.rows()]
        return tuple(dict.fromkeys([*self.deciding, *self.cameras.sets(), *rows]))

    @cached_property
    def detectable(self) -> float:
        """The smallest change of success without a camera that the audit finds 8 times in 10, if no
        other test finds anything; NaN where it can find none."""
        tests = 2 * len(self.cameras.names)
        return detectable(self.episodes, self.looks[-1].share / tests)

    def seeds(self, episodes: int) -> range:
        """The seeds of the first ``episodes``."""
        return range(self.seed, self.seed + episodes)

    def reached(self, outcomes: Outcomes) -> tuple[Look, Judgement] | None:
        """The last look for which everything is there, but none after the one that settled all;
        None before the first."""
        newest = None
        for look in self.looks:
            if self._missing(outcomes, self.deciding, look.episodes):
                break
            judgement = judged(self._paired(outcomes, look.episodes), look)
            newest = (look, judgement)
            if judgement.settled.all():
                break
        return newest

    def stopped(self, outcomes: Outcomes) -> tuple[Look, Judgement] | None:
        """The look at which verdicts need no more episodes; None while they do."""
        newest = self.reached(outcomes)
        if newest is None:
            return None
        look, judgement = newest
        return newest if look == self.looks[-1] or judgement.settled.all() else None

    def wanted(self, outcomes: Outcomes) -> list[tuple[Condition, int]]:
        """The episodes to play now, by condition and seed; none where the audit is done."""
        end = self.stopped(outcomes)
        if end is not None:
            return self._missing(outcomes, self.every, end[0].episodes)
        for look in self.looks:
            if missing := self._missing(outcomes, self.deciding, look.episodes):
                return missing
        raise AssertionError("an audit that is not stopped lacks episodes")

    def first(self, outcomes: Outcomes, condition: Condition, episodes: int) -> Array:
        """(n,) bool: success in the first ``episodes`` of ``condition``."""
        return np.array([outcomes[condition][seed] for seed in self.seeds(episodes)], bool)

    def _missing(
        self, outcomes: Outcomes, conditions: tuple[Condition, ...], episodes: int
    ) -> list[tuple[Condition, int]]:
        """The episodes that are not there; seed after seed, so that what is there is paired."""
        return [
            (condition, seed)
            for seed in self.seeds(episodes)
            for condition in conditions
            if seed not in outcomes.get(condition, {})
        ]

    def _paired(self, outcomes: Outcomes, episodes: int) -> PairedOutcomes:
        rows = [self.cameras.deciding(name) for name in self.cameras.names]

        def stacked(conditions: list[Condition]) -> Array:
            return np.stack([self.first(outcomes, one, episodes) for one in conditions])  # (C, n)

        return PairedOutcomes(
            intact=self.first(outcomes, INTACT, episodes),  # (n,)
            removed=stacked([row.removed.condition for row in rows]),
            alone=stacked([row.alone.condition for row in rows]),
            floor=stacked([row.floor.condition for row in rows]),
        )


def scale(look: Look) -> float:
    """The factor of a p-value at ``look``, so that 0.05 is the limit for all looks."""
    return LEVEL / look.share
