"""``madviz compare P --conditions all third_a=black first=delay``: conditions of one policy.

Every condition is played on the same seeds and compared with the first one, pair by pair, as
``compare.py`` does with policies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypedDict

from madviz.errors import UserError, saving
from madviz.guard.policy import guard_note
from madviz.measure.audit.audited_policy import repeats_itself
from madviz.measure.episodes import check_begin, clipped_words, unsupported
from madviz.measure.pairs import turned, write_page
from madviz.measure.statistics import PairedRow, SuccessRate, pair
from madviz.measure.table import Table, seeds_of_run
from madviz.observation.condition import Condition
from madviz.observation.grammar import parse_condition
from madviz.policies.measured import RateRow
from madviz.subsets import cameras_of


class PlayedCondition(RateRow):
    """The success rate of one condition."""

    subset: str
    occlusions: dict[str, dict[str, Any]]
    """By camera: the fields of ``Occlusion``."""
    moves: dict[str, dict[str, Any]]
    """By camera: the fields of ``Displacement``."""
    begin: int
    """The step from which it holds."""
    outside: float
    """The share of action numbers outside [-1, 1]; they were clipped."""


class ConditionPairRow(PairedRow):
    """The first condition against another one, as they are written on the command line."""

    first: str
    second: str


class ConditionsFile(TypedDict):
    """The document that ``madviz compare --conditions --json`` writes."""

    schema: int
    policy: str
    task: str
    definition: str
    seed: int
    conditions: dict[str, PlayedCondition]
    guard: str
    """A sentence on the guard; '' without one."""
    comparisons: list[ConditionPairRow]
    broken: list[Any]
    """Empty: a single policy that is broken is an error."""


def compare_conditions(
    policy: str,
    words: Sequence[str],
    *,
    episodes: int,
    seed: int,
    workers: int | None,
    page: Path | None = None,
) -> ConditionsFile:
    """Plays ``policy`` under every condition; ``page`` gets the episodes that turned. Raises
    UserError for a condition that is none, or that the policy cannot act under, before anything is
    played."""
    if len(words) < 2 or len(set(words)) < len(words):
        raise UserError(f"expected two or more conditions, each once, found {' '.join(words)!r}")
    seeds = seeds_of_run(seed, episodes)
    table, loaded = Table.opened(policy)
    streams = loaded.spec.streams
    asked = {word: parse_condition(word, cameras_of(streams)) for word in words}
    played = {word: condition.noticed(streams) for word, condition in asked.items()}
    for condition in played.values():
        check_begin(condition.begin, loaded.spec.task, loaded.spec.horizon)
        mask = condition.mask(streams)
        if not loaded.supports(mask):
            raise unsupported(loaded.spec, mask)
    with TemporaryDirectory(prefix="madviz-") as folder:
        if page is not None and not repeats_itself(policy, loaded):
            table.kept = folder
        table.play([(c, s) for c in played.values() for s in seeds], workers, progress=True)
        found = _document(table, seed, asked, played, guard_note(loaded))
        if page is not None:
            with saving(found, f"--page {page}"):
                _show(page, found, table, played)
    return found


def _document(
    table: Table,
    seed: int,
    asked: Mapping[str, Condition],
    played: Mapping[str, Condition],
    guard: str,
) -> ConditionsFile:
    outcomes = {word: table.outcomes(condition) for word, condition in played.items()}
    rows: dict[str, PlayedCondition] = {}
    for word in asked:
        rows[word] = {
            "subset": played[word].subset,
            "occlusions": {name: asdict(o) for name, o in asked[word].occlusions},
            "moves": {name: asdict(move) for name, move in asked[word].moves},
            "begin": played[word].begin,
            "outside": table.outside([played[word]]),
            **SuccessRate.counted(outcomes[word].values()).row(),
        }
    first, *others = asked
    return {
        "schema": 1,
        "policy": table.spec.name,
        "task": table.spec.task,
        "definition": table.definition,
        "seed": seed,
        "conditions": rows,
        "guard": guard,
        "comparisons": [
            {"first": first, "second": word, **pair(outcomes[first], outcomes[word]).row()}
            for word in others
        ],
        "broken": [],
    }


def _show(page: Path, found: ConditionsFile, table: Table, played: Mapping[str, Condition]) -> None:
    """Writes the page of episodes that turned."""
    first, *others = played
    jobs = {word: partial(table.job, condition) for word, condition in played.items()}
    outcomes = {word: table.outcomes(condition) for word, condition in played.items()}
    lists = [
        turned(outcomes[first], outcomes[word], (jobs[first], jobs[word]), (first, word))
        for word in others
    ]
    title = f"{found['policy']}: conditions compared"
    write_page(page, title, conditions_table(found), lists, table.runner)


def conditions_table(result: ConditionsFile) -> str:
    """The comparison as lines."""
    wide = max(map(len, result["conditions"]))
    lines = [f"{result['policy']} on {result['task']}: success {result['definition']}"]
    for word, row in result["conditions"].items():
        lines.append(f"  {word:{wide}} {SuccessRate.read(row)}")
    for pair_row in result["comparisons"]:
        low, high = pair_row["ci95"]
        first = pair_row["first"]
        second = pair_row["second"]
        lines.append(
            f"{first} minus {second}, paired by seed: {pair_row['difference']:+.2f} "
            f"[{low:+.2f}, {high:+.2f}]   only {first} {pair_row['first_only']}, only "
            f"{second} {pair_row['second_only']} of {pair_row['n']}   "
            f"exact p = {pair_row['p']:.2g}"
        )
    shares = [row["outside"] for row in result["conditions"].values()]
    lines += filter(None, [clipped_words(sum(shares) / len(shares)), result["guard"]])
    return "\n".join(lines)
