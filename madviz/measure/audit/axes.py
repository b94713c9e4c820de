"""Axes along which an audit breaks a camera, or moves it, little by little.

    [camera.]what=low:high       third_a.pan=-20:20   third_a.blur=0:1   light=0.3:2

    forward right up    metres           blur noise    strength, 0 to 1
    pan tilt            degrees          patch         its side, as a share of the picture
    zoom                times            loss          share of the pictures that are lost
    light               times            delay         decisions, 0 to 10

Without a camera, all of them change together. An axis begins where nothing is changed (1 for zoom
and light, 0 for all others), so it has one side or two: pan=-20:20 has left and right, blur=0:1
has one. Places on a side are shares of its length; zoom and light go by equal factors, delay by
whole decisions.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from madviz.errors import UserError, unknown
from madviz.observation.ablation import BRIGHTEST, LATEST, Occlusion, OcclusionKind
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement
from madviz.subsets import cameras_of

MOVES = {"forward": "m", "right": "m", "up": "m", "pan": "°", "tilt": "°", "zoom": "times"}
FAILURES: dict[str, tuple[OcclusionKind, str, float]] = {
    "blur": ("blur", "strength", 1.0),
    "noise": ("noise", "strength", 1.0),
    "patch": ("patch", "of the side", 1.0),
    "loss": ("dropout", "of the pictures", 1.0),
    "delay": ("delay", "steps", float(LATEST)),
    "light": ("light", "times", BRIGHTEST),
}
"""Kind, unit, and the number that is strength 1; of a patch, that is its side."""
WAYS = {
    "forward": ("forward", "back"),
    "right": ("to the right", "to the left"),
    "up": ("up", "down"),
    "pan": ("turned right", "turned left"),
    "tilt": ("turned up", "turned down"),
    "zoom": ("zoomed in", "zoomed out"),
    "light": ("brighter", "darker"),
}
"""The words for more and for less."""
PLACES = 40
"""On a side."""
_AXIS = re.compile(r"(?:(\w+)\.)?([a-z]+)=(-?[\d.]+):(-?[\d.]+)")


@dataclass(frozen=True)
class Side:
    """An axis from where nothing is changed to one end."""

    streams: tuple[str, ...]
    """The policy's."""
    named: str | None
    """The camera that changes; None: all of them."""
    what: str
    end: float

    @property
    def start(self) -> float:
        """The number at which nothing is changed."""
        return 1.0 if self.what in ("zoom", "light") else 0.0

    @property
    def unit(self) -> str:
        return MOVES[self.what] if self.what in MOVES else FAILURES[self.what][1]

    @property
    def way(self) -> str:
        """``turned right``; ``blur`` where there is one way."""
        if self.what not in WAYS:
            return self.what
        return WAYS[self.what][self.end < self.start]

    @cached_property
    def places(self) -> tuple[float, ...]:
        """Where episodes may be played, shares of the side in (0, 1]."""
        count = round(self.end) if self.what == "delay" else PLACES
        return tuple((number + 1) / count for number in range(count))

    def value(self, share: float) -> float:
        """The number of the axis at ``share`` of the side."""
        if self.start:
            return round(self.end**share, 4)
        return round(self.end * share, 4)

    def condition(self, share: float) -> Condition:
        """The condition at ``share``, in the spelling of ``Condition.noticed``."""
        return self._condition(self.value(share)).noticed(self.streams)

    def _condition(self, value: float) -> Condition:
        changed = (self.named,) if self.named else cameras_of(self.streams)
        if self.what in MOVES:
            move = Displacement(**{self.what: value})
            return Condition("all", (), tuple((name, move) for name in changed))
        kind, _, most = FAILURES[self.what]
        occlusion = Occlusion(kind, value / most)
        if kind == "patch":
            occlusion = Occlusion(kind, width=value, height=value)
        return Condition("all", tuple((name, occlusion) for name in changed))


@dataclass(frozen=True)
class Axis:
    """One word of ``--along``."""

    name: str
    """``third_a.pan``."""
    sides: tuple[Side, ...]
    """The side of more, and that of less."""


def parse_axis(word: str, streams: tuple[str, ...]) -> Axis:
    """The axis of ``word``, for a policy with ``streams``. Raises UserError for what is none, and
    for one that does not contain the place where nothing is changed."""
    match = _AXIS.fullmatch(word)
    if match is None:
        raise UserError(
            f"expected an axis such as third_a.pan=-20:20 or light=0.3:2, found {word!r:.60}"
        )
    named, what, low, high = match.groups()
    cameras = cameras_of(streams)
    if named is not None and named not in cameras:
        raise unknown("camera", named, list(cameras))
    if what not in MOVES and what not in FAILURES:
        raise unknown("axis", what, [*MOVES, *FAILURES])
    try:
        upper, lower = (Side(streams, named, what, float(end)) for end in (high, low))
    except ValueError as error:
        raise UserError(f"expected two numbers in {word!r:.60}, found another word") from error
    start = upper.start
    if not lower.end <= start <= upper.end or lower.end == upper.end:
        raise UserError(
            f"expected a range with {start:g}, where nothing is changed, found {word!r:.60}"
        )
    if lower.end < start and (lower.end <= 0 if start else what in FAILURES):
        raise UserError(f"expected {what} of {'more than 0' if start else '0 or more'}: {word!r}")
    if what == "delay" and upper.end != round(upper.end):
        raise UserError(f"expected whole decisions, found {word!r:.60}")
    sides = tuple(side for side in (upper, lower) if side.end != start)
    for side in sides:
        side.condition(1.0)  # Raises where the end is out of range.
    return Axis(word.partition("=")[0], sides)
