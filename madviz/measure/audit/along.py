"""``madviz audit --along third_a.pan=-20:20``: how much is too much?

Every scene is played with nothing changed first; those that the policy solves are then played with
the camera turned, blurred or late, each scene once on a side of an axis. ``curve.py`` says where,
and what the outcomes say: the share of these scenes that is still solved, with its band, and the
breaking point at which half of them are lost. All sides meet the same scenes in the same order.

A side ends when its breaking point is known to ``ENOUGH`` of the axis, or is shown to lie beyond
the end, or when its episodes are used up. All of it follows from the outcomes, so that an audit
which was stopped goes on where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

from madviz.measure.audit.axes import Axis, Side, parse_axis
from madviz.measure.audit.curve import FallingCurve
from madviz.measure.audit.lost_cameras import INTACT
from madviz.measure.statistics import SuccessRate
from madviz.measure.store import MEMORY, Store
from madviz.measure.table import Table
from madviz.measure.workers import Workers, processes
from madviz.observation.condition import Condition
from madviz.policies.config import definition_of
from madviz.policies.measured import RateRow
from madviz.types import EnvSpec, Policy

EPISODES = 60
"""An axis takes at most that many, beside those with nothing changed, which all axes share."""
TOGETHER = 4
"""Episodes of a side that are chosen before any of them is played."""
LEAST = 16
"""Episodes of a side before it may end early."""
ENOUGH = 0.08
"""Width of the interval of a breaking point, as a share of its axis."""


class PlaceRow(TypedDict):
    """One place on a side."""

    at: float
    """In the unit of the axis."""
    n: int
    successes: int
    kept: float
    """The share of the scenes, solved with nothing changed, that is solved here."""
    ci95: list[float]
    """The band of ``kept``."""


class SideRow(TypedDict):
    """A side of an axis."""

    way: str
    """``turned right``."""
    end: float
    n: int
    breaking: float | None
    """Where half of its success is gone; None: beyond the end."""
    ci95: list[float | None]
    """Its interval, the near end first; None for an end beyond the axis."""
    places: list[PlaceRow]
    turned: list[tuple[float, int]]
    """The places and seeds of the episodes that were lost here alone, in the order of places."""


class AxisRow(TypedDict):
    """One axis; ``camera`` is None where all cameras change."""

    axis: str
    camera: str | None
    what: str
    unit: str
    sides: list[SideRow]


class AlongFile(TypedDict):
    """The document of ``madviz audit --along``."""

    schema: int
    policy: str
    task: str
    digest: str
    definition: str
    seed: int
    episodes: int
    """At most, for each axis."""
    labels: dict[str, str]
    intact: RateRow
    """With nothing changed."""
    outside: float
    """The share of action numbers outside [-1, 1]; they were clipped."""
    axes: list[AxisRow]


@dataclass
class SidePlay:
    """The episodes of a side: those that were played, and those that are due."""

    side: Side
    most: int
    """Episodes."""
    share: float
    """The side, as a part of its axis."""
    played: list[tuple[int, int, bool]] = field(default_factory=list)
    """Number of the place, seed, success."""
    batch: list[tuple[int, int]] = field(default_factory=list)
    """Number of the place and seed of the episodes that are due."""

    def __post_init__(self) -> None:
        self.curve = FallingCurve(self.side.places)

    @property
    def done(self) -> bool:
        if len(self.played) >= self.most:
            return True
        _, low, high = self.curve.breaking()
        return len(self.played) >= LEAST and (low > 1 or (high - low) * self.share <= ENOUGH)

    def plan(self, solved: Sequence[int]) -> bool:
        """Chooses the next episodes, on the seeds ``solved`` that are not used yet; False where
        there are too few of them."""
        begun = len(self.played)
        count = min(TOGETHER, self.most - begun)
        if not self.batch and len(solved) >= begun + count:
            seeds = solved[begun : begun + count]
            self.batch = list(zip(self.curve.next(count), seeds, strict=True))
        return bool(self.batch)

    def wanted(self) -> list[tuple[Condition, int]]:
        """The conditions and seeds of the episodes that are due."""
        return [(self.side.condition(self.side.places[place]), seed) for place, seed in self.batch]

    def take(self, table: Table) -> None:
        """Takes the outcomes of the episodes that were due."""
        for (condition, seed), (place, _) in zip(self.wanted(), self.batch, strict=True):
            success = table.outcomes(condition)[seed]
            self.curve.add(place, success)
            self.played.append((place, seed, success))
        self.batch = []

    def row(self) -> SideRow:
        """The side in a document."""
        breaking, *ends = self.curve.breaking()
        places = self.side.places
        rows: list[PlaceRow] = []
        for number, (kept, low, high) in enumerate(zip(*self.curve.band(), strict=True)):
            outcomes = [success for place, _, success in self.played if place == number]
            rows.append(
                {
                    "at": self.side.value(places[number]),
                    "n": len(outcomes),
                    "successes": sum(outcomes),
                    "kept": round(float(kept), 4),
                    "ci95": [float(low), float(high)],
                }
            )
        return {
            "way": self.side.way,
            "end": self.side.end,
            "n": len(self.played),
            "breaking": self._at(breaking),
            "ci95": [self._at(end) for end in ends],
            "places": rows,
            "turned": [
                (self.side.value(places[place]), seed)
                for place, seed, success in sorted(self.played)
                if not success
            ],
        }

    def _at(self, share: float) -> float | None:
        return None if share > 1 else self.side.value(share)


def along(
    policy: str | Path | Policy,
    words: Sequence[str],
    *,
    seed: int,
    episodes: int = EPISODES,
    workers: int | None = None,
    store: Store | None = None,
    progress: bool = False,
    kept: str = "",
) -> AlongFile:
    """Finds the breaking points of ``policy`` along the axes ``words`` (``axes.py``), on the seeds
    from ``seed`` on; the rest as in ``audit``. Raises UserError for an axis that is none."""
    table, loaded = Table.opened(policy, store or Store(MEMORY), own=True)
    table.kept = kept
    axes = dict.fromkeys(parse_axis(word, loaded.spec.streams) for word in words)
    sides: dict[Axis, list[SidePlay]] = {}
    for axis in axes:
        share = 1 / len(axis.sides)
        most = max(1, round(episodes * share))
        sides[axis] = [SidePlay(side, most, share) for side in axis.sides]
    count = processes(workers) if table.reference else 0
    pool = Workers(count, niceness=5) if count else None
    try:
        tried = play(table, [one for each in sides.values() for one in each], seed, pool, progress)
        env, _ = table.runner.opened(table.job(INTACT, seed))
        return _document(table, sides, seed, tried, episodes, env.spec)
    finally:
        table.runner.close()
        if pool is not None:
            pool.close()


def play(
    table: Table, sides: list[SidePlay], seed: int, pool: Workers | None, progress: bool
) -> int:
    """Plays until all ``sides`` are done, or scenes that the policy solves are too rare; how many
    scenes were played with nothing changed."""
    most = 2 * max(side.most for side in sides)
    tried = 2 * TOGETHER
    seeds = range(seed, seed + most)
    while True:
        table.play([(INTACT, one) for one in seeds[:tried]], pool or 0, progress)
        solved = [one for one in seeds[:tried] if table.outcomes(INTACT)[one]]
        left = [side for side in sides if not side.done]
        planned = [side for side in left if side.plan(solved)]
        if not planned and (not left or tried >= most):
            return min(tried, most)
        table.play([one for side in planned for one in side.wanted()], pool or 0, progress)
        for side in planned:
            side.take(table)
        if any(len(side.played) + TOGETHER > len(solved) for side in left):
            tried += 2 * TOGETHER


def _document(
    table: Table,
    sides: dict[Axis, list[SidePlay]],
    seed: int,
    tried: int,
    episodes: int,
    env: EnvSpec,
) -> AlongFile:
    spec = table.spec
    intact = [table.outcomes(INTACT)[one] for one in range(seed, seed + tried)]
    played = {
        condition
        for each in sides.values()
        for one in each
        for condition in map(one.side.condition, one.side.places)
    }
    return {
        "schema": 1,
        "policy": spec.name,
        "task": spec.task,
        "digest": spec.digest,
        "definition": definition_of(env),
        "seed": seed,
        "episodes": episodes,
        "labels": {camera.name: camera.label for camera in env.cameras},
        "intact": SuccessRate.counted(intact).row(),
        "outside": table.outside([INTACT, *sorted(played, key=str)]),
        "axes": [
            {
                "axis": axis.name,
                "camera": axis.sides[0].named,
                "what": axis.sides[0].what,
                "unit": axis.sides[0].unit,
                "sides": [one.row() for one in plays],
            }
            for axis, plays in sides.items()
        ],
    }
