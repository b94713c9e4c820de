"""How often each panel of a page is brought up to date.

What a visitor watches while switching a camera comes first and with every frame: pictures, action,
state. Tables, curves and the scene follow a few times a second. When somebody has touched something
they all follow soon; but what is being touched right now never waits for a table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from madviz.app.panel import Assign, Panel
from madviz.session.frame import Frame

FASTEST = 1 / 40
"""Seconds between two frames that are shown: more would be wasted on a browser."""
AFTER = 0.1
"""Seconds after which tables, curves and the scene follow when something was touched; at full speed
they follow at their own times, or they would delay the next touch."""
SHORTEST_WAIT = 0.01


@dataclass
class TimedPanel:
    """A panel, and how often it is brought up to date while nothing is touched."""

    panel: Panel
    period: float
    """Seconds."""
    updated: float = -1e9
    number: int = 0
    """The last frame it showed."""

    def interval(self, frame: Frame) -> float:
        """Seconds between two updates. At full speed, what is not watched all the time waits twice
        as long: the machine is wanted for the simulator and the pictures."""
        return self.period * (2 if frame.pace.speed is None and self.period > FASTEST else 1)

    def due(self, frame: Frame) -> float:
        """When it is brought up to date next."""
        return self.updated + self.interval(frame)


class Refresh:
    """Decides which panels show a frame now, and which a little later."""

    def __init__(self, panels: Sequence[TimedPanel]) -> None:
        self.panels = panels
        self._touched: object = None

    def again(self) -> None:
        """The newest frame is shown again: something beside it has changed."""
        for timed in self.panels:
            timed.number = 0

    def update(self, frame: Frame, now: float, interrupted: Callable[[], bool]) -> list[Assign]:
        """Hands ``frame`` to every panel; the changes of those that are due at ``now``, in seconds.
        Ends early where ``interrupted`` says that somebody waits for a newer frame."""
        for timed in self.panels:
            timed.panel.note(frame)
        world = frame.world
        touched = (world.change, world.ablation, world.policy, frame.pace.phase, frame.pace.error)
        urgent = touched != self._touched  # Somebody has touched something since the last frame.
        self._touched = touched
        if urgent:
            self._hasten(frame, now)
        changes = []
        for timed in self.panels:
            shown = timed.number == frame.pace.number
            watched = urgent and timed.period <= FASTEST
            if shown or (now < timed.due(frame) and not watched):
                continue
            if interrupted() and not urgent:
                break
            timed.updated = now
            timed.number = frame.pace.number  # Before its update: ``again`` may come during it.
            changes += timed.panel.update(frame)
            if getattr(timed.panel, "unsettled", False):
                timed.number = 0  # It shows the same frame again when it is due.
        return changes

    def _hasten(self, frame: Frame, now: float) -> None:
        """Makes every panel due in ``AFTER`` seconds, or, at full speed, when it was due anyway if
        that is later."""
        for timed in self.panels:
            soon = now + AFTER - timed.interval(frame)
            at_full_speed = frame.pace.speed is None
            timed.updated = max(timed.updated, soon) if at_full_speed else soon

    def wait(self, frame: Frame, now: float) -> float | None:
        """In how many seconds a panel that does not show ``frame`` yet is due; None: all do."""
        later = [
            timed.due(frame) - now for timed in self.panels if timed.number != frame.pace.number
        ]
        return max(SHORTEST_WAIT, min(later)) if later else None
