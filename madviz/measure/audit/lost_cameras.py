"""Which cameras an audit takes away, in which ways, and which conditions that gives.

    removed   this camera is away          how   dropped   its feature is left out
    alone     all others are away                black     it sends black
    none      all are away                       mean      it sends its mean picture
                                                 noise     it sends noise
                                                 frozen    it sends its first picture for ever

A policy that cannot act without a camera has no *dropped* for it. Its verdicts then come from the
mean picture, and the report says so. For a policy with the cameras a and b that can drop either of
them, but not both:

    the verdict on a rests on     a removed, dropped     the subset b
                                  a alone, dropped       the subset a
                                  none, mean             a and b send their mean pictures

With three cameras there are 7 rows in each of 5 ways, and all cameras: 36. Some are one and the
same condition (of two cameras, the first removed is the second alone); it is played once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from madviz.observation.ablation import Occlusion
from madviz.observation.condition import Condition
from madviz.subsets import camera_of, cameras_of, every_mask, name_of
from madviz.types import Array

What = Literal["removed", "alone", "none"]
How = Literal["dropped", "black", "mean", "noise", "frozen"]
WHATS: tuple[What, ...] = ("removed", "alone", "none")
HOWS: tuple[How, ...] = ("dropped", "black", "mean", "noise", "frozen")
OCCLUSIONS: dict[How, Occlusion] = {
    "black": Occlusion("black"),
    "mean": Occlusion("mean"),
    "noise": Occlusion("noise"),
    "frozen": Occlusion("freeze"),
}
MOST_FOR_SHAPLEY = 5
"""Cameras; six have 64 sets."""
INTACT = Condition("all")


@dataclass(frozen=True)
class AuditRow:
    """A condition by the names that an audit has for it."""

    camera: str | None
    """None where all cameras are away."""
    what: What
    how: How
    condition: Condition


@dataclass(frozen=True)
class DecidingRows:
    """The rows that the verdict on one camera rests on."""

    removed: AuditRow
    alone: AuditRow
    floor: AuditRow
    """No camera at all, to hold ``alone`` against."""


@dataclass(frozen=True)
class Cameras:
    """A policy's cameras, and which it can be without."""

    streams: tuple[str, ...]
    supports: Callable[[Array], bool]
    """Tells whether the policy can act on a mask (V,) bool, as ``Policy.supports``."""
    hows: tuple[How, ...] = HOWS
    """The ways to play. Rows that verdicts rest on are played anyway."""

    @property
    def names(self) -> tuple[str, ...]:
        return cameras_of(self.streams)

    def row(self, what: What, camera: str | None, how: How) -> AuditRow:
        return AuditRow(camera, what, how, self._condition(self._away(what, camera), how))

    def deciding(self, camera: str) -> DecidingRows:
        """The rows that the verdict on ``camera`` rests on. Each drops cameras if the policy can
        act without them. The floor does so only if ``alone`` does: the two must differ in nothing
        but ``camera``, as far as the policy allows it."""
        alone = self._droppable("alone", camera)
        floor = self._droppable("none", None)
        if alone.how == "mean":
            floor = self.row("none", None, "mean")
        return DecidingRows(self._droppable("removed", camera), alone, floor)

    def rows(self) -> Iterator[AuditRow]:
        """All rows of an audit, those of dropping first."""
        decisive = {self._droppable("none", None)}
        for name in self.names:
            deciding = self.deciding(name)
            decisive |= {deciding.removed, deciding.alone, deciding.floor}
        for how in HOWS:
            for what in WHATS:
                for camera in (None,) if what == "none" else self.names:
                    row = self.row(what, camera, how)
                    possible = how != "dropped" or self._can_drop(self._away(what, camera))
                    if row in decisive or (possible and how in self.hows):
                        yield row

    def sets(self) -> tuple[Condition, ...]:
        """The conditions of every set of cameras, in the order of ``every_mask``; Shapley values
        are made from them. Cameras are dropped if all can be, else they send the mean picture; ()
        where there are too many cameras."""
        if len(self.names) > MOST_FOR_SHAPLEY:
            return ()
        lost = [
            tuple(name for name, on in zip(self.names, mask, strict=True) if not on)
            for mask in every_mask(len(self.names))
        ]
        how: How = "dropped" if all(map(self._can_drop, lost)) else "mean"
        return tuple(self._condition(away, how) for away in lost)

    def _droppable(self, what: What, camera: str | None) -> AuditRow:
        """The row that drops cameras if the policy can act without them, else the mean picture."""
        can_drop = self._can_drop(self._away(what, camera))
        return self.row(what, camera, "dropped" if can_drop else "mean")

    def _away(self, what: What, camera: str | None) -> tuple[str, ...]:
        """The cameras that are away."""
        if what == "removed":
            return tuple(name for name in self.names if name == camera)
        return tuple(name for name in self.names if what == "none" or name != camera)

    def _can_drop(self, away: tuple[str, ...]) -> bool:
        return self.supports(self._mask(away))

    def _condition(self, away: tuple[str, ...], how: How) -> Condition:
        if how == "dropped" or not away:
            return Condition(name_of(self._mask(away), self.streams))
        return Condition("all", tuple((name, OCCLUSIONS[how]) for name in sorted(away)))

    def _mask(self, away: tuple[str, ...]) -> Array:
        """(V,) bool: the streams of all other cameras."""
        return np.array([camera_of(stream) not in away for stream in self.streams], bool)
