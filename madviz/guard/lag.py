"""A late picture: the change of the picture is compared with earlier movements of the robot.

From a change of the cells, fitted weights read how the robot moved. Where that agrees best with
what the robot did some steps ago, the picture is late. Sums of products are kept for every lag, and
fade by 5 % a step, so that about twenty steps count.
"""

from __future__ import annotations

import numpy as np

from madviz.guard.values import StreamValues
from madviz.types import Array

LAGS = 11
"""Lags of 0 to 10 steps are compared; 0 and 1 are on time."""
FADE = 0.95
FIRST = 10
"""Changes of the picture before lags are compared."""
MARGIN = 0.2
"""The agreement of a late picture exceeds that of a picture on time by this at least."""
CLEAR = 0.2
"""Movements that differ by less, in units of the state, count as equal."""
AGREEMENT = 0.7
"""The agreement, at most 1, of a late picture at its lag."""
ON_TIME = 0.5
"""The agreement, at most 1, that shows that a picture is late no more."""


class LagTest:
    """The lags of one stream."""

    def __init__(self, values: StreamValues) -> None:
        self._numbers = list(values.numbers)
        self._matrix = values.matrix()
        self.possible = bool(self._numbers)
        """False where nothing can be read from this stream's pictures."""
        self.restart()

    def restart(self) -> None:
        """Forgets the past."""
        self.count = 0
        self._products = np.zeros(LAGS)
        self._seen = 0.0
        self._moved = np.zeros(LAGS)

    def read(self, change: Array) -> Array:
        """(J,): the robot's movement, as read from a ``change`` of the cells (441,)."""
        return change @ self._matrix

    def moved(self, now: Array, before: Array) -> Array:
        """(J,): the robot's movement between two states, in the numbers that ``read`` gives."""
        return (now - before)[self._numbers]

    def add(self, change: Array, states: Array) -> None:
        """Takes the ``change`` of the cells since the step before. ``states`` (LAGS + 1, numbers of
        the state): the newest ones, the newest first."""
        read = self.read(change)  # (J,)
        moved = (states[:-1] - states[1:])[:, self._numbers]  # (LAGS, J), one row for each lag
        self._products = FADE * self._products + moved @ read
        self._seen = FADE * self._seen + float(read @ read)
        self._moved = FADE * self._moved + (moved * moved).sum(1)
        self.count += 1

    def agreements(self) -> Array:
        """(LAGS,) from -1 to 1."""
        return self._products / np.sqrt(self._seen * self._moved + 1e-9)

    def lag(self) -> int:
        """By how many steps the picture is late; 0 where nothing says so."""
        if not self.possible or self.count < FIRST:
            return 0
        found = self.agreements()
        best = int(np.argmax(found))
        late = best >= 2 and found[best] >= AGREEMENT
        return best if late and found[best] - max(found[0], found[1]) >= MARGIN else 0

    def on_time(self) -> bool:
        """True where the pictures of the last steps agree best with the newest movements."""
        if not self.possible or self.count < FIRST:
            return False
        found = self.agreements()
        return bool(max(found[0], found[1]) >= max(ON_TIME, found[2:].max() + 0.05))

    def caught_up(
        self, change: Array, states: Array, behind: int, clearly: bool = False
    ) -> bool | None:
        """True where the ``change`` of the cells shows all that the robot did in the last
        ``behind`` + 1 steps, False where it shows the first of these steps alone, None where that
        cannot be decided. ``clearly`` asks for half the distance. ``states`` as in ``add``."""
        if not self.possible or behind + 1 >= len(states):
            return None
        all_of_it = self.moved(states[0], states[behind + 1])
        first_step = self.moved(states[behind], states[behind + 1])
        apart = float(np.abs(all_of_it - first_step).max())
        if apart < CLEAR:
            return None
        read = self.read(change)
        share = 0.25 if clearly else 1.0
        return bool(((read - all_of_it) ** 2).sum() < share * ((read - first_step) ** 2).sum())
