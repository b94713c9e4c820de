"""The page of ``madviz compare A B``: episodes that one policy solves and the other does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from madviz.measure.episodes import Job, Runner
from madviz.measure.evidence import Evidence, Outcomes
from madviz.measure.pairs import turned, write_page
from madviz.observation.condition import Condition
from madviz.policies import checkpoint


def write_comparison(
    page: Path,
    title: str,
    text: str,
    policies: Sequence[Evidence],
    table: Mapping[str, Sequence[Outcomes]],
) -> None:
    """Writes the lines of ``text``, and episodes of the first of ``policies`` beside those of the
    others; ``table`` has the outcomes of each by subset. Raises UserError for missing weights."""

    def job(policy: Evidence, subset: str, seed: int) -> Job:
        spec = checkpoint.describe(policy.path).spec
        condition = Condition(policy.name_there(subset) or subset).noticed(spec.streams)
        return Job(str(policy.path), spec.digest, condition, seed)

    first = policies[0]
    lists = [
        turned(
            rows[0],
            outcomes,
            (partial(job, first, name), partial(job, other, name)),
            (f"{first.config.name}, {name}", f"{other.config.name}, {name}"),
        )
        for name, rows in table.items()
        for other, outcomes in zip(policies[1:], rows[1:], strict=True)
    ]
    write_page(page, title, text, lists, Runner())
