"""The numbers of a state by what they say: angles, the place of the robot, and so on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StateNumbers:
    """Indices into a state (S,), by what they say. A task gives those that it knows."""

    paper: tuple[int, ...] = ()
    """Those that the paper's table counts, where its code has more."""
    start: tuple[int, ...] = ()
    """Those that tell where the object began, whatever the cameras show."""
    changes: tuple[tuple[int, int], ...] = ()
    """Pairs, the same quantity now and a decision ago, whose difference is a speed that the state
    does not hold by itself."""
    angles: tuple[int, ...] = ()
    """Angles and their speeds, in radians."""
    robot: tuple[int, ...] = ()
    """Those that say where the robot is, no speeds and no past ones; none: all."""

    @property
    def named(self) -> tuple[int, ...]:
        """Every index that is given, in no particular order."""
        pairs = [number for pair in self.changes for number in pair]
        return (*self.paper, *self.start, *pairs, *self.angles, *self.robot)
