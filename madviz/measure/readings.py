"""results/readings.csv: every reading of rates on reporting seeds that the repository shows.

    date,policy,task,digest,first,last
    2026-11-25,metaworld-push-mad-light,metaworld/push,3f0c...,10000,10099

A range of seeds is untouched for a policy as long as nobody has read rates of it on that range. A
policy that is trained again after a reading has another digest and the same name: its new rates are
a second reading, because the first one may have led to the training.

``madviz eval --card``, ``madviz report --evaluate`` and ``benchmarks guard-trial`` add a row for a
policy below checkpoints/ or results/ beside this file. Nothing is written where there is no such
file, as in other people's folders.
"""

from __future__ import annotations

import csv
from collections.abc import Collection, Sequence
from datetime import date
from pathlib import Path
from typing import NamedTuple

from madviz.policies.seeds import REPORTING, use_of

LEDGER = Path("results") / "readings.csv"
SHOWN = ("checkpoints", "results")
"""Folders beside the ledger's whose policies the repository shows."""


class Reading(NamedTuple):
    """A row: the policy's name, task and digest, and the seeds ``first`` to ``last``."""

    date: str
    policy: str
    task: str
    digest: str
    first: int
    last: int


def ledger_of(folder: Path) -> Path | None:
    """The ledger that the policy in ``folder`` belongs to; None where it belongs to none."""
    place = folder.resolve()
    for root in place.parents:
        if (root / LEDGER).is_file() and place.relative_to(root).parts[0] in SHOWN:
            return root / LEDGER
    return None


def readings(folder: Path) -> list[Reading]:
    """All rows of the ledger that ``folder`` belongs to, in their order; none without one."""
    ledger = ledger_of(folder)
    if ledger is None:
        return []
    with ledger.open(newline="") as file:
        rows = csv.DictReader(file)
        return [
            Reading(**{**row, "first": int(row["first"]), "last": int(row["last"])}) for row in rows
        ]


def note_reading(folder: Path, policy: str, task: str, digest: str, seeds: Collection[int]) -> None:
    """Adds a row to the ledger that ``folder`` belongs to, for the reporting ones of ``seeds``."""
    ledger = ledger_of(folder)
    read = [seed for seed in seeds if use_of([seed]) == REPORTING]
    if ledger is None or not read:
        return
    row = Reading(date.today().isoformat(), policy, task, digest, min(read), max(read))
    with ledger.open("a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(row)


def times_read(rows: Sequence[Reading], policy: str, task: str, seeds: range) -> tuple[int, int]:
    """How often a policy of this name and task was read on any of ``seeds``, and how many digests
    it had."""
    same = [
        row
        for row in rows
        if (row.policy, row.task) == (policy, task)
        and row.first < seeds.stop
        and row.last >= seeds.start
    ]
    return len(same), len({row.digest for row in same})
