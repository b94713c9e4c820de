"""The guard in an audit: each way of breaking a camera once more, with the guard.

A camera that is broken is played on the same scenes by the policy with its guard
(``madviz.guard``), and so are intact episodes, in which it should notice nothing. Verdicts on
cameras rest on the policy without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np

from madviz.measure.audit.lost_cameras import INTACT, Cameras
from madviz.measure.statistics import SuccessRate
from madviz.measure.table import Table
from madviz.observation.condition import Condition
from madviz.policies.measured import RateRow


class GuardedRow(RateRow):
    """A broken camera with the guard, or no broken camera at all."""

    noticed: list[int | None]
    """By episode: the step at which the guard noticed something; None: at none."""


class GuardedRows(TypedDict):
    """The part of audit.json that ``--guard`` adds."""

    note: str
    """One sentence on what the guard does."""
    intact: GuardedRow
    broken: dict[str, dict[str, GuardedRow]]
    """By camera and way of breaking."""


def guarded_rows(
    table: Table, cameras: Cameras, seeds: range, workers: int | None, progress: bool, note: str
) -> GuardedRows:
    """Plays what is missing in ``table``, the episodes of the guarded policy. Raises UserError as
    ``Table.play`` does."""
    rows = [row for row in cameras.rows() if row.what == "removed" and row.how != "dropped"]
    conditions = [INTACT, *(row.condition for row in rows)]
    table.play([(each, seed) for seed in seeds for each in conditions], workers, progress)

    def known(condition: Condition) -> GuardedRow:
        results = [table.results(condition)[seed] for seed in seeds]
        rate = SuccessRate.counted(result.success for result in results)
        return {**rate.row(), "noticed": [result.noticed for result in results]}

    broken: dict[str, dict[str, GuardedRow]] = {}
    for row in rows:
        broken.setdefault(str(row.camera), {})[row.how] = known(row.condition)
    return {"note": note, "intact": known(INTACT), "broken": broken}


def noticed_words(noticed: Sequence[int | None]) -> str:
    """``noticed after 1 step (median)``."""
    steps = [step + 1 for step in noticed if step is not None]
    if not steps:
        return "never noticed"
    median = float(np.median(steps))
    words = f"noticed after {median:g} step{'' if median == 1 else 's'} (median)"
    missed = len(noticed) - len(steps)
    return f"{words}, but not in {missed} of {len(noticed)} episodes" if missed else words


def alarms_words(noticed: Sequence[int | None]) -> str:
    """``no false alarm in 100 intact episodes``."""
    alarms = sum(step is not None for step in noticed)
    count = len(noticed)
    words = "no false alarm" if not alarms else f"{alarms} false alarm{'' if alarms == 1 else 's'}"
    return f"{words} in {count} intact episode{'' if count == 1 else 's'}"
