"""Which episodes an audit plays next, and when it has played enough.

First the conditions that verdicts rest on, from look to look of ``rule.py``, until all cameras are
settled or the planned episodes are played. Then every other condition, on the same seeds. A plan
keeps nothing: what it says follows from the outcomes that it is shown, so that an audit goes on
after a kill with whatever was stored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from madviz.measure.audit.conditions import INTACT, Cameras, Played
from madviz.measure.audit.rule import LEVEL, Judgement, Look, PairedOutcomes, judged, looks
from madviz.measure.formulas import detectable
from madviz.types import Array

Outcomes = Mapping[Played, Mapping[int, bool]]
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
    def deciding(self) -> tuple[Played, ...]:
        """What verdicts rest on, each once."""
        names, cameras = self.cameras.names, self.cameras
        removed = [cameras.deciding("removed", name).played for name in names]
        alone = [cameras.deciding("alone", name).played for name in names]
        floors = [cameras.floor(name).played for name in names]
        return tuple(dict.fromkeys([INTACT, *removed, *alone, *floors]))

    @cached_property
    def every(self) -> tuple[Played, ...]:
        """All that is played, each once, in the order in which it is played."""
        others = [condition.played for condition in self.cameras.every()]
        return tuple(dict.fromkeys([*self.deciding, *self.cameras.sets(), *others]))

    @cached_property
    def detectable(self) -> float:
        """The smallest change of success without a camera that the audit finds 8 times in 10, if no
        other test finds anything; NaN where it can find none."""
        tests = 2 * len(self.cameras.names)
        return detectable(self.episodes, self.looks[-1].share / tests)

    def seeds(self, episodes: int) -> range:
        """The first ``episodes``."""
        return range(self.seed, self.seed + episodes)

    def reached(self, outcomes: Outcomes) -> tuple[Look, Judgement] | None:
        """The last look for which everything is there, but none after the one that settled all;
        None before the first."""
        found = None
        for look in self.looks:
            if self._missing(outcomes, self.deciding, look.episodes):
                break
            found = (look, judged(self._paired(outcomes, look.episodes), look))
            if found[1].settled.all():
                break
        return found

    def stopped(self, outcomes: Outcomes) -> tuple[Look, Judgement] | None:
        """The look at which the audit needs no more episodes for its verdicts, if it is there."""
        found = self.reached(outcomes)
        if found is None or not (found[0] == self.looks[-1] or found[1].settled.all()):
            return None
        return found

    def wanted(self, outcomes: Outcomes) -> list[tuple[Played, int]]:
        """The episodes to play now, by what is played and seed; none where the audit is done."""
        end = self.stopped(outcomes)
        if end is not None:
            return self._missing(outcomes, self.every, end[0].episodes)
        for look in self.looks:
            if missing := self._missing(outcomes, self.deciding, look.episodes):
                return missing
        raise AssertionError("an audit that is not stopped lacks episodes")

    def outcomes_of(self, outcomes: Outcomes, played: Played, episodes: int) -> Array:
        """(n,) bool of the first ``episodes``."""
        return np.array([outcomes[played][seed] for seed in self.seeds(episodes)], bool)

    def _missing(
        self, outcomes: Outcomes, wanted: tuple[Played, ...], episodes: int
    ) -> list[tuple[Played, int]]:
        """Seed after seed, so that what is there is paired."""
        return [
            (played, seed)
            for seed in self.seeds(episodes)
            for played in wanted
            if seed not in outcomes.get(played, {})
        ]

    def _paired(self, outcomes: Outcomes, episodes: int) -> PairedOutcomes:
        cameras = self.cameras

        def rows(played: list[Played]) -> Array:
            return np.stack([self.outcomes_of(outcomes, each, episodes) for each in played])

        return PairedOutcomes(
            intact=self.outcomes_of(outcomes, INTACT, episodes),
            removed=rows([cameras.deciding("removed", name).played for name in cameras.names]),
            alone=rows([cameras.deciding("alone", name).played for name in cameras.names]),
            floor=rows([cameras.floor(name).played for name in cameras.names]),
        )


def scale(look: Look) -> float:
    """What a p-value at ``look`` is multiplied by, so that 0.05 is the limit for all looks."""
    return LEVEL / look.share
