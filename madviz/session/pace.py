"""When a session's next decision is due, and how fast it really goes.

With 10 decisions a second the step at 3.20 s makes the next one due at 3.30 s. If the machine gets
there at 3.34 s the next is due at 3.40 s; if a step is more than one period late, the times restart
from now.
"""

from __future__ import annotations

import math
from collections import deque

HOLD = 2.0
"""Seconds an ended episode stays on the page before the next one starts; none at full speed."""
HOLD_TO_READ = 10.0
"""The same where a camera was changed, or policies were compared: there is a sentence to read."""
RATE_WINDOW = 20
"""Decisions over which the achieved rate is measured."""


class StepClock:
    """Times in seconds, all from the same clock. Belongs to the thread of its session."""

    def __init__(self, speed: float | None) -> None:
        """``speed``: decisions a second; None: as fast as it goes."""
        self.speed = speed
        self.due = 0.0
        """When the next decision is due."""
        self._intervals: deque[float] = deque(maxlen=RATE_WINDOW)
        self._stepped: float | None = None

    @property
    def period(self) -> float:
        """Seconds between two decisions."""
        return 0.0 if self.speed is None else 1 / self.speed

    def begin(self, now: float) -> None:
        """An episode begins: its first decision is due in a period."""
        self.due = now + self.period
        self._stepped = None

    def step(self, now: float) -> None:
        """A decision was taken."""
        if self._stepped is not None:
            self._intervals.append(now - self._stepped)
        self._stepped = now
        self.due = max(self.due + self.period, now)

    def hold(self, now: float, to_read: bool) -> None:
        """An episode is over; the next may begin after ``HOLD``, or ``HOLD_TO_READ``."""
        seconds = HOLD_TO_READ if to_read else HOLD
        self.due = now + (seconds if self.speed is not None else 0.0)

    def interrupt(self) -> None:
        """Forgets the rate: what comes next says nothing of it."""
        self._stepped = None

    def forget(self) -> None:
        """The rate is measured anew."""
        self._intervals.clear()
        self._stepped = None

    @property
    def rate(self) -> float:
        """Decisions per second achieved; NaN until there are enough to tell."""
        taken = sum(self._intervals)
        return len(self._intervals) / taken if len(self._intervals) >= 4 and taken else math.nan
