"""Rows of a table: rates of one method on one or several tasks, and how two of them differ.

A *row*'s cells hold single episodes and not rates, by *unit*: task, training seed, episode seed. So
any two rows can be paired unit by unit, trainings of several seeds pool by themselves, and an
average over tasks is the same code as one task:

    row          units of `all`                                   rate
    mad, hammer  (hammer, 1, 5000) yes, (hammer, 1, 5001) no ...  99 of 100
    mad, 2 tasks the same and (push, 1, 5000) yes ...             190 of 200

Where a task has several trainings, intervals are over trainings (Student's t,
``formulas.student``), and at least as wide as those over scenes, which all trainings share. With
one training they are over its episodes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from madviz.measure.evidence import Evidence
from madviz.measure.statistics import (
    Interval,
    SuccessRate,
    difference_interval,
    interval_over_trainings,
    mean_interval,
)
from madviz.policies.seeds import use_of

Unit = tuple[str, int, int]
"""Task, training seed, episode seed."""


@dataclass
class Row:
    """See the module."""

    label: str
    cells: dict[str, dict[Unit, bool]] = field(default_factory=dict)
    evidence: list[Evidence] = field(default_factory=list)

    @classmethod
    def pooled(cls, label: str, rows: Iterable[Row]) -> Row:
        """One row with the episodes of all ``rows``."""
        whole = cls(label)
        for row in rows:
            whole.evidence += row.evidence
            for column, cell in row.cells.items():
                whole.cells.setdefault(column, {}).update(cell)
        return whole

    @property
    def tasks(self) -> tuple[str, ...]:
        """Those with an episode in any cell, in alphabetical order."""
        return tuple(sorted({task for task, _ in self._trained}))

    @property
    def trainings(self) -> int:
        """Training seeds, at most, on any of the tasks."""
        return max(Counter(task for task, _ in self._trained).values(), default=0)

    @property
    def training_seeds(self) -> set[int]:
        """The seeds of its trainings, on any task."""
        return {seed for _, seed in self._trained}

    @property
    def seeds(self) -> str:
        """The use of its episodes' seeds, see ``madviz.policies.seeds``."""
        return use_of(unit[2] for cell in self.cells.values() for unit in cell)

    def only(self, keeps: Callable[[Unit], bool]) -> Row:
        """The same row with the episodes that ``keeps`` names, and their policies."""
        cells = {
            column: {unit: success for unit, success in cell.items() if keeps(unit)}
            for column, cell in self.cells.items()
        }
        row = Row(self.label, cells)
        row.evidence = [e for e in self.evidence if (e.config.task, e.seed) in row._trained]
        return row

    def on(self, tasks: Collection[str]) -> Row:
        """The same row with the episodes of ``tasks`` only."""
        return self.only(lambda unit: unit[0] in tasks)

    def seeded(self, seeds: Collection[int]) -> Row:
        """The same row with the trainings of ``seeds`` only."""
        return self.only(lambda unit: unit[1] in seeds)

    def equal_trainings(self) -> Row:
        """The same row with equally many trainings of every task, those of the lowest seeds. So a
        task that was trained more often does not pull an average towards itself."""
        seeds: dict[str, list[int]] = {}
        for task, seed in sorted(self._trained):
            seeds.setdefault(task, []).append(seed)
        least = min(map(len, seeds.values()), default=0)
        return self.only(lambda unit: unit[1] in seeds[unit[0]][:least])

    @property
    def _trained(self) -> set[tuple[str, int]]:
        """Task and training seed of every training with an episode in any cell."""
        return {unit[:2] for cell in self.cells.values() for unit in cell}

    def rate(self, column: str) -> SuccessRate | None:
        """None where nothing was measured."""
        cell = self.cells.get(column)
        if not cell:
            return None
        rate = SuccessRate.counted(cell.values())
        return replace(rate, interval=_interval(cell, rate.interval, mean_interval))

    def shares(self, columns: Sequence[str]) -> dict[Unit, float]:
        """By unit, the share of ``columns`` that succeeded; of units that have them all."""
        cells = [self.cells.get(column, {}) for column in columns]
        common = set.intersection(*map(set, cells)) if cells else set()
        return {unit: sum(cell[unit] for cell in cells) / len(cells) for unit in sorted(common)}

    def measured(self, columns: Sequence[str]) -> list[str]:
        """Those of ``columns`` that this row has episodes of."""
        return [column for column in columns if self.cells.get(column)]

    def mean(self, columns: Sequence[str]) -> SuccessRate | None:
        """Over those of ``columns`` that this row has; None where it has but one, which is no
        mean."""
        present = self.measured(columns)
        if len(present) < 2:
            return None
        shares = self.shares(present)
        if not shares:
            return None
        rate = SuccessRate.mean(list(shares.values()), len(present))
        parts = len(present)

        def over_scenes(scenes: Sequence[float], trainings: int) -> Interval:
            return mean_interval(scenes, parts * trainings)

        return replace(rate, interval=_interval(shares, rate.interval, over_scenes))


@dataclass(frozen=True)
class Difference:
    """First minus second, on the units and columns that both have."""

    value: float
    interval: Interval
    n: int
    tasks: tuple[str, ...]
    columns: tuple[str, ...]
    trainings: tuple[float, ...]
    """The difference of every training seed that all tasks have."""

    def __str__(self) -> str:
        """How a difference is written everywhere: ``+15 points [+2, +28]``."""
        low, high = self.interval
        return f"{signed(self.value)} points [{signed(low)}, {signed(high)}]"


def signed(share: float) -> str:
    """Points with their sign; what rounds to nothing is +0, not -0."""
    return f"{round(100 * share) + 0.0:+.0f}"


def difference(first: Row, second: Row, columns: Sequence[str]) -> Difference | None:
    """The difference of the means over the columns that both rows have; None where no episodes can
    be paired."""
    shared = [c for c in first.measured(columns) if c in second.measured(columns)]
    mine = first.shares(shared)
    theirs = second.shares(shared)
    units = [unit for unit in mine if unit in theirs]
    if not shared or not units:
        return None
    gaps = [mine[unit] - theirs[unit] for unit in units]
    tasks = tuple(sorted({unit[0] for unit in units}))
    value = sum(gaps) / len(gaps)
    by_training: dict[int, list[float]] = {}
    for (_, training, _), gap in zip(units, gaps, strict=True):
        by_training.setdefault(training, []).append(gap)
    seeds = [{unit[1] for unit in units if unit[0] == task} for task in tasks]
    complete = sorted(set.intersection(*seeds))
    trainings = tuple(sum(by_training[s]) / len(by_training[s]) for s in complete)
    interval = _interval(
        dict(zip(units, gaps, strict=True)),
        difference_interval(gaps),
        lambda scenes, _: difference_interval(scenes),
        -1.0,
    )
    return Difference(value, interval, len(gaps), tasks, tuple(shared), trainings)


def _interval(
    values: Mapping[Unit, float],
    episodes: Interval,
    over_scenes: Callable[[Sequence[float], int], Interval],
    least: float = 0.0,
) -> Interval:
    """``episodes``, the interval over episodes, where every task has one training. Several meet the
    same scenes, so their episodes are not independent: the interval is then over trainings, and at
    least as wide as ``over_scenes``, of the means by scene and the number of trainings. Values lie
    between ``least`` and 1."""
    trainings: dict[str, dict[int, list[float]]] = {}
    scenes: dict[tuple[str, int], list[float]] = {}
    for (task, training, seed), value in values.items():
        trainings.setdefault(task, {}).setdefault(training, []).append(value)
        scenes.setdefault((task, seed), []).append(value)
    most = max(map(len, trainings.values()))
    if most == 1:
        return episodes
    groups = [[by_seed[s] for s in sorted(by_seed)] for _, by_seed in sorted(trainings.items())]
    means = [sum(scene) / len(scene) for scene in scenes.values()]
    return interval_over_trainings(groups, over_scenes(means, most), least)
