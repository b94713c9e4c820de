"""A late picture: the change of the picture is compared with earlier movements of the robot.

From a change of the cells, fitted weights read how the robot moved. Where that agrees best with
what the robot did some steps ago, the picture is late. Sums of products are kept for every lag, and
fade by 5 % a step, so that about twenty steps count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from madviz.guard.pictures import CELLS
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


class Path(NamedTuple):
    """Where the robot was in the last steps, the newest first, in the numbers that are watched."""

    states: Array
    """(LAGS + 1, numbers)."""
    moves: Array
    """(LAGS, numbers): the movement of each step."""
    squares: Array
    """(LAGS, numbers): its square."""

    @classmethod
    def of(cls, states: Array) -> Path:
        """The path through ``states`` (LAGS + 1, numbers), the newest first."""
        moves = states[:-1] - states[1:]
        return cls(states, moves, moves * moves)


class LagTest:
    """The lags of one stream."""

    def __init__(self, values: StreamValues, numbers: int) -> None:
        """``numbers`` of the robot are watched; those that cannot be read have weights of 0."""
        read = list(values.numbers)
        self._matrix = np.zeros((CELLS * CELLS, numbers))
        self._matrix[:, read] = values.matrix()
        self._readable = np.zeros(numbers)
        self._readable[read] = 1
        self.possible = bool(read)
        """False where nothing can be read from this stream's pictures."""
        self.restart()

    def restart(self) -> None:
        """Forgets the past."""
        self.count = 0
        self._products = np.zeros(LAGS)
        self._seen = 0.0
        self._moved = np.zeros(LAGS)

    def add(self, change: Array, path: Path) -> None:
        """Takes the ``change`` of the cells (441,) since the step before."""
        read = change @ self._matrix  # (numbers,)
        self._products = FADE * self._products + path.moves @ read  # (LAGS,)
        self._seen = FADE * self._seen + float(read @ read)
        self._moved = FADE * self._moved + path.squares @ self._readable
        self.count += 1

    def agreements(self) -> list[float]:
        """By lag, from -1 to 1."""
        return (self._products / np.sqrt(self._seen * self._moved + 1e-9)).tolist()

    def lag(self) -> int:
        """By how many steps the picture is late; 0 where nothing says so."""
        if not self.possible or self.count < FIRST:
            return 0
        found = self.agreements()
        best = found.index(max(found))
        late = best >= 2 and found[best] >= AGREEMENT
        return best if late and found[best] - max(found[0], found[1]) >= MARGIN else 0

    def on_time(self) -> bool:
        """True where the pictures of the last steps agree best with the newest movements."""
        if not self.possible or self.count < FIRST:
            return False
        found = self.agreements()
        return max(found[0], found[1]) >= max(ON_TIME, max(found[2:]) + 0.05)

    def caught_up(
        self, change: Array, path: Path, behind: int, clearly: bool = False
    ) -> bool | None:
        """True where the ``change`` of the cells shows all that the robot did in the last
        ``behind`` + 1 steps, False where it shows the first of these steps alone, None where that
        cannot be decided. ``clearly`` asks for half the distance."""
        if not self.possible or behind + 1 >= len(path.states):
            return None
        before = path.states[behind + 1]
        all_of_it = (path.states[0] - before) * self._readable
        first_step = (path.states[behind] - before) * self._readable
        if np.abs(all_of_it - first_step).max() < CLEAR:
            return None
        read = change @ self._matrix  # (numbers,)
        share = 0.25 if clearly else 1.0
        return bool(((read - all_of_it) ** 2).sum() < share * ((read - first_step) ** 2).sum())
