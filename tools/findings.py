"""The findings in one table: a claim, the measurement, the result, the paper, a verdict.

Every result is a difference of two rows of the report's tables, paired by scene. The verdict
follows from its interval, the way of learning and the number of trainings:

    expected          interval                       verdict
    first is ahead    above 0                        shown here, or shown in part
    first is ahead    holds 0                        not shown
    first is ahead    below 0                        contradicted here
    both are alike    within 10 points either way    shown here, or shown in part
    both are alike    holds 0, and is wider          not shown
    both are alike    holds no 0, goes beyond 10     contradicted here

*Shown here* takes reinforcement learning, which the paper's sentences are about, with three
trainings or more. All else is *shown in part*. A claim whose rows were not measured is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from madviz.measure.statistics import Interval
from madviz.report.claims import SEVERAL
from madviz.report.layouts import THREE
from madviz.report.rows import Difference, Row, difference, signed
from madviz.report.tables import ResultTable
from madviz.system.markdown import markdown_table

MARGIN = 0.1
"""Differences within this either way count as none."""
HEADER = ("our claim", "measured", "result, in points", "the paper", "verdict")
ALONE = THREE[1:]
PUSH = "metaworld/push"
CUBE = "maniskill/push-cube"
REACH = "toy/reach"
REINFORCED = ("scratch", "rewards")
"""The tables of policies that learn by reinforcement."""
LOSSES = {
    PUSH: ("mad, alpha 0.25", "mad, alpha 0.8", "merged-only", "singular-only"),
    CUBE: ("mad, alpha 0.25", "mad, alpha 0.8", "merged-only"),
}
"""Those of the design *Loss and episodes* that have all cameras, by task."""
LEVELS = ("turns", "all")
"""Its recorded episodes, by what drove: all cameras and single ones in turn, or all alone."""
Place = tuple[str, str | tuple[str, ...]]
"""A layout's key, and a row's label in its table, or those of several rows, whose mean is meant."""


@dataclass(frozen=True)
class Finding:
    """A row: ``first`` minus ``second`` on the mean of ``columns``, on one task."""

    claim: str
    task: str
    first: Place
    second: Place
    columns: tuple[str, ...]
    paper: str
    expected: Literal["ahead", "alike"] = "ahead"
    headline: bool = False
    """True where README has a sentence of it above the table."""

    @property
    def place(self) -> str:
        """The task's name; the toy's says that it is no robot."""
        suite, name = self.task.split("/")
        return f"{suite}/{name}, no robot" if suite == "toy" else name


@dataclass(frozen=True)
class Judged:
    """A finding with its difference, from rows that were measured."""

    finding: Finding
    gap: Difference
    measured: str
    """How: the learning, the task, trainings, episodes and seeds."""
    verdict: str

    @property
    def label(self) -> str:
        """The claim and its task, for a picture."""
        return f"{self.finding.claim} ({self.finding.place})"

    @property
    def words(self) -> str:
        """The verdict and the difference, without the interval."""
        return f"**{self.verdict}**, {signed(self.gap.value)} points on {self.finding.place}"


FINDINGS = (
    Finding(
        "On a single camera, MAD succeeds more often than Merged Only",
        PUSH,
        ("overall", "mad"),
        ("overall", "merged-only"),
        ALONE,
        "MAD is ahead",
    ),
    Finding(
        "On a single camera, MAD succeeds more often than Merged Only",
        CUBE,
        ("overall", "mad"),
        ("overall", "merged-only"),
        ALONE,
        "MAD is ahead",
    ),
    Finding(
        "With all cameras, MAD succeeds as often as Merged Only",
        PUSH,
        ("overall", "mad"),
        ("overall", "merged-only"),
        ("all",),
        "MAD is ahead",
        "alike",
    ),
    Finding(
        "On a single camera, MAD succeeds more often than a policy of that camera only, alpha 0.25",
        PUSH,
        ("overall", "mad"),
        ("overall", "single"),
        ALONE,
        "MAD is ahead",
    ),
    Finding(
        "On a single camera, MAD succeeds more often than a policy of that camera only, alpha 0.8",
        PUSH,
        ("alpha", "alpha 0.8"),
        ("overall", "single"),
        ALONE,
        "MAD is ahead",
    ),
    Finding(
        "On a single camera, MAD succeeds more often than a policy of that camera only, alpha 0.25",
        CUBE,
        ("overall", "mad"),
        ("overall", "single"),
        ALONE,
        "MAD is ahead",
    ),
    Finding(
        "Trained by rewards, MAD on Third A succeeds as often as a policy of Third A only",
        CUBE,
        ("scratch", "mad, paper-vectorised"),
        ("scratch", "single, paper-vectorised"),
        ("third_a",),
        "MAD is ahead",
        "alike",
    ),
    Finding(
        "Trained by rewards, MAD succeeds more often than Merged Only, over all cameras and each "
        "alone",
        REACH,
        ("rewards", "mad"),
        ("rewards", "merged-only"),
        THREE,
        "MAD is ahead",
        headline=True,
    ),
    Finding(
        "Trained by rewards, MAD on Third A succeeds more often than a policy of Third A only",
        REACH,
        ("rewards", "mad"),
        ("rewards", "single"),
        ("third_a",),
        "MAD is ahead",
    ),
    Finding(
        "With two cameras turned away, MAD succeeds as often as the third's own policy, alpha 0.25",
        CUBE,
        ("occlusion", "mad"),
        ("occlusion", "single"),
        ("all",),
        "alike: 63 % and 62 %",
        "alike",
    ),
    Finding(
        "With two cameras turned away, MAD succeeds as often as the third's own policy, alpha 0.8",
        CUBE,
        ("occlusion", "mad, alpha 0.8"),
        ("occlusion", "single"),
        ("all",),
        "alike: 63 % and 62 %",
        "alike",
        headline=True,
    ),
    Finding(
        "With colour and depth, MAD succeeds as often as a policy that always has both",
        CUBE,
        ("modality", "mad, one-rgbd"),
        ("modality", "single, one-rgbd"),
        ("all",),
        "alike",
        "alike",
    ),
    Finding(
        "With pictures of several sizes, MAD succeeds as often as with one size",
        CUBE,
        ("resolution", "mad"),
        ("resolution", "mad, one size"),
        THREE,
        "no loss",
        "alike",
    ),
    *(
        Finding(
            "From the same recorded episodes, on a single camera, MAD succeeds more often than "
            f"Merged Only, {alpha}",
            task,
            ("crossed", tuple(f"mad, {alpha}, {level}" for level in LEVELS)),
            ("crossed", tuple(f"merged-only, {level}" for level in LEVELS)),
            ALONE,
            "MAD is ahead",
            # With alpha 0.25 MAD recorded the episodes: it alone learns from its own mistakes.
            headline=alpha == "alpha 0.8",
        )
        for task in (PUSH, CUBE)
        for alpha in ("alpha 0.25", "alpha 0.8")
    ),
    *(
        Finding(
            "On a single camera, policies succeed more often if single cameras drove, too, while "
            "their episodes were recorded",
            task,
            ("crossed", tuple(f"{loss}, turns" for loss in LOSSES[task])),
            ("crossed", tuple(f"{loss}, all" for loss in LOSSES[task])),
            ALONE,
            "not asked",
            headline=True,
        )
        for task in (PUSH, CUBE)
    ),
)


def judged(tables: Sequence[ResultTable], claims: Sequence[Finding] = FINDINGS) -> list[Judged]:
    """Every one of ``claims`` whose rows are in ``tables``, in their order."""
    found = []
    for finding in claims:
        first = _row(tables, finding, finding.first)
        second = _row(tables, finding, finding.second)
        gap = difference(first, second, list(first.cells)) if first and second else None
        if first and gap:
            rewards = finding.first[0] in REINFORCED
            learning = "reinforcement learning" if rewards else "imitation"
            measured = f"{learning}, {finding.place}, {_amount(gap)}, {first.seeds}"
            said = verdict(finding.expected, gap.interval, rewards, len(gap.trainings))
            found.append(Judged(finding, gap, measured, said))
    return found


def headline_sentences(found: Sequence[Judged]) -> list[str]:
    """A sentence for each claim that is a headline, with what was found on its tasks."""
    claims = dict.fromkeys(one.finding.claim for one in found if one.finding.headline)
    return [
        f"{claim}: {'. And '.join(one.words for one in found if one.finding.claim == claim)}."
        for claim in claims
    ]


def findings_table(tables: Sequence[ResultTable]) -> str:
    """Markdown; '' where no claim can be judged from ``tables``."""
    rows = [
        [one.finding.claim, one.measured, str(one.gap), one.finding.paper, one.verdict]
        for one in judged(tables)
    ]
    return markdown_table(HEADER, rows) if rows else ""


def verdict(expected: str, interval: Interval, rewards: bool, trainings: int) -> str:
    """See the module."""
    low, high = interval
    if expected == "ahead":
        shown = low > 0
        contradicted = high < 0
    else:
        shown = -MARGIN <= low and high <= MARGIN
        contradicted = not shown and (low > 0 or high < 0)
    if contradicted:
        return "contradicted here"
    if not shown:
        return "not shown"
    return "shown here" if rewards and trainings >= SEVERAL else "shown in part"


def _amount(gap: Difference) -> str:
    trainings = len(gap.trainings)
    return f"{trainings} training{'s' * (trainings > 1)}, n = {gap.n}"


def _row(tables: Sequence[ResultTable], finding: Finding, place: Place) -> Row | None:
    """The columns that ``finding`` is about, of one row, or of several beside each other; None
    where one is missing."""
    key, labels = place
    wanted = (labels,) if isinstance(labels, str) else labels
    rows = {
        row.label: row
        for table in reversed(tables)  # The first of its label counts.
        if table.layout.key == key
        for task, row in table.rows
        if task == finding.task
    }
    if not rows.keys() >= set(wanted):
        return None
    found = Row(", ".join(wanted))
    for number, label in enumerate(wanted):
        for column in rows[label].measured(finding.columns):
            found.cells[f"{column} {number}"] = rows[label].cells[column]
    return found
