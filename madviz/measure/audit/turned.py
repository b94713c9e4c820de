"""The episodes behind an audit's verdicts: pairs of an intact episode and one that turned."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from madviz.measure.audit.account import condition_label
from madviz.measure.audit.along import AlongFile, SideRow
from madviz.measure.audit.along_account import at
from madviz.measure.audit.axes import parse_axis
from madviz.measure.audit.document import AuditFile
from madviz.measure.audit.lost_cameras import INTACT, Cameras
from madviz.measure.audit.sentences import HOW_WORDS
from madviz.measure.episodes import Job
from madviz.measure.pairs import EpisodePair, in_turns
from madviz.observation.condition import Condition
from madviz.types import Policy

Jobs = Callable[[Condition, int], Job]
"""The episode of a condition and a seed."""


def audit_pairs(found: AuditFile, policy: Policy, job: Jobs, most: int) -> list[EpisodePair]:
    """At most ``most`` pairs: of every condition the first seed that was lost, then others."""
    cameras = Cameras(policy.spec.streams, policy.supports)
    known: set[Condition] = set()
    lists = []
    for row in found["conditions"]:
        condition = cameras.row(row["what"], row["camera"], row["how"]).condition
        if condition in known:
            continue
        known.add(condition)
        name = f"{condition_label(found, row)} ({HOW_WORDS[row['how']]})"
        lists.append(
            [
                EpisodePair(
                    job(INTACT, s), job(condition, s), ("all cameras", name), (won, not won)
                )
                for won, seeds in ((True, row.get("lost", [])), (False, row.get("won", [])))
                for s in seeds
            ]
        )
    return in_turns(lists, most)


def along_pairs(
    found: AlongFile, words: Sequence[str], policy: Policy, job: Jobs, most: int
) -> list[EpisodePair]:
    """At most ``most`` pairs: of every side the episode that was lost nearest to its breaking
    point, then others."""
    lists = []
    axes = dict.fromkeys(parse_axis(word, policy.spec.streams) for word in words)
    for axis, row in zip(axes, found["axes"], strict=True):
        who = found["labels"].get(row["camera"] or "", "all cameras")
        for side, side_row in zip(axis.sides, row["sides"], strict=True):
            conditions = {side.value(share): side.condition(share) for share in side.places}
            lists.append(
                [
                    EpisodePair(
                        job(INTACT, seed),
                        job(conditions[where], seed),
                        ("nothing changed", f"{who}, {side_row['way']}: {at(row['unit'], where)}"),
                        (True, False),
                    )
                    for where, seed in _nearest(side_row)
                ]
            )
    return in_turns(lists, most)


def _nearest(side: SideRow) -> list[tuple[float, int]]:
    wanted = side["end"] if side["breaking"] is None else side["breaking"]
    return sorted(side["turned"], key=lambda one: abs(one[0] - wanted))
