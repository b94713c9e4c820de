"""What an audit does to a policy's cameras, and which episodes that takes.

    removed   this camera is away          how   dropped   its feature is left out
    alone     all others are away                black     it sends black
    none      all are away                       mean      it sends its mean picture
                                                 noise     it sends noise
                                                 frozen    it sends its first picture for ever

A policy that cannot act without a camera has no *dropped* for it. Its verdicts then come from the
mean picture, and the report says so.

With three cameras that is 7 conditions in each of 5 ways, and all cameras: 36. Some are one and the
same (of two cameras, the first removed is the second alone); their episodes are played once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from madviz.measure.episodes import Occlusions
from madviz.observation.ablation import Occlusion
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


@dataclass(frozen=True)
class Played:
    """What decides an episode besides policy and seed."""

    subset: str
    occlusions: Occlusions = ()


INTACT = Played("all")


@dataclass(frozen=True)
class AuditCondition:
    """A row of an audit."""

    camera: str | None
    """None where all cameras are away."""
    what: What
    how: How
    played: Played


@dataclass(frozen=True)
class Cameras:
    """A policy's cameras, and which it can be without."""

    streams: tuple[str, ...]
    supports: Callable[[Array], bool]
    """Of a mask (V,) bool, as ``Policy.supports``."""
    hows: tuple[How, ...] = HOWS
    """The ways to play. What verdicts rest on is played anyway."""

    @property
    def names(self) -> tuple[str, ...]:
        return cameras_of(self.streams)

    def away(self, what: What, camera: str | None) -> tuple[str, ...]:
        """The cameras that are away."""
        if what == "removed":
            return tuple(name for name in self.names if name == camera)
        return tuple(name for name in self.names if what == "none" or name != camera)

    def can_drop(self, away: tuple[str, ...]) -> bool:
        return self.supports(self._mask(away))

    def played(self, away: tuple[str, ...], how: How) -> Played:
        """The episodes with the cameras ``away`` in the way ``how``."""
        if how == "dropped" or not away:
            return Played(name_of(self._mask(away), self.streams))
        return Played("all", tuple((name, OCCLUSIONS[how]) for name in sorted(away)))

    def condition(self, what: What, camera: str | None, how: How) -> AuditCondition:
        return AuditCondition(camera, what, how, self.played(self.away(what, camera), how))

    def deciding(self, what: What, camera: str | None) -> AuditCondition:
        """The condition that a verdict rests on: dropped, or the mean picture."""
        droppable = self.can_drop(self.away(what, camera))
        return self.condition(what, camera, "dropped" if droppable else "mean")

    def floor(self, camera: str) -> AuditCondition:
        """No camera at all, to hold ``camera`` alone against; in the same way if that can be."""
        how = self.deciding("alone", camera).how
        return (
            self.deciding("none", None) if how == "dropped" else self.condition("none", None, how)
        )

    def every(self) -> Iterator[AuditCondition]:
        """All rows of an audit, those of dropping first."""
        rests_on = [self.deciding("none", None)]
        for name in self.names:
            rests_on += [self.deciding("removed", name), self.deciding("alone", name)]
            rests_on.append(self.floor(name))
        for how in HOWS:
            for what in WHATS:
                for camera in (None,) if what == "none" else self.names:
                    one = self.condition(what, camera, how)
                    possible = how != "dropped" or self.can_drop(self.away(what, camera))
                    if one in rests_on or (possible and how in self.hows):
                        yield one

    def sets(self) -> tuple[Played, ...]:
        """The episodes of every set of cameras, in the order of ``every_mask``: what Shapley values
        are made from. By dropping if all can be dropped, else by the mean picture; () where there
        are too many cameras."""
        if len(self.names) > MOST_FOR_SHAPLEY:
            return ()
        lost = [
            tuple(name for name, on in zip(self.names, mask, strict=True) if not on)
            for mask in every_mask(len(self.names))
        ]
        how: How = "dropped" if all(map(self.can_drop, lost)) else "mean"
        return tuple(self.played(away, how) for away in lost)

    def _mask(self, away: tuple[str, ...]) -> Array:
        return np.array([camera_of(stream) not in away for stream in self.streams], bool)
