"""``madviz compare P --conditions all third_a=black first=delay``: conditions of one policy.

Every condition is played on the same seeds and compared with the first one, pair by pair, as
``compare.py`` does with policies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from madviz.errors import UserError
from madviz.measure.episodes import unsupported
from madviz.measure.evaluate import Evaluation, evaluate
from madviz.measure.statistics import SuccessRate, pair
from madviz.observation.grammar import parse_condition
from madviz.policies import checkpoint
from madviz.subsets import cameras_of, mask_of, name_of


@dataclass(frozen=True)
class ConditionRates:
    """A condition and its episodes."""

    word: str
    subset: str
    evaluation: Evaluation

    @property
    def outcomes(self) -> dict[int, bool]:
        return self.evaluation.outcomes(self.subset)

    @property
    def success(self) -> SuccessRate:
        return SuccessRate.of(sum(self.outcomes.values()), len(self.outcomes))


def compare_conditions(
    policy: str, words: Sequence[str], *, episodes: int, seed: int, workers: int | None
) -> dict[str, Any]:
    """Plays ``policy`` under every condition. Raises UserError for a condition that is none, or
    that the policy cannot act under, before anything is played."""
    if len(words) < 2 or len(set(words)) < len(words):
        raise UserError(f"expected two or more conditions, each once, found {' '.join(words)!r}")
    loaded = checkpoint.load_policy(policy)
    streams = loaded.spec.streams
    conditions = {word: parse_condition(word, cameras_of(streams)) for word in words}
    subsets: dict[str, str] = {}
    for word, condition in conditions.items():
        mask = mask_of(condition.subset, streams)
        if not loaded.supports(mask):
            raise unsupported(loaded.spec, mask)
        subsets[word] = name_of(mask, streams)
    found = [
        ConditionRates(
            word,
            subsets[word],
            evaluate(
                policy,
                (subsets[word],),
                episodes=episodes,
                seed=seed,
                workers=workers,
                occlusions=condition.occlusions,
                progress=True,
            ),
        )
        for word, condition in conditions.items()
    ]
    return {
        "schema": 1,
        "policy": loaded.spec.name,
        "task": loaded.spec.task,
        "definition": found[0].evaluation.definition,
        "seed": seed,
        "conditions": {
            each.word: {
                "subset": each.subset,
                "occlusions": {n: asdict(o) for n, o in conditions[each.word].occlusions.items()},
                "success": each.success.value,
                "n": each.success.n,
                "ci95": list(each.success.interval),
            }
            for each in found
        },
        "comparisons": [_against(found[0], other) for other in found[1:]],
        "broken": [],
    }


def _against(first: ConditionRates, second: ConditionRates) -> dict[str, Any]:
    paired = pair(first.outcomes, second.outcomes)
    return {
        "first": first.word,
        "second": second.word,
        "n": paired.n,
        "first_only": paired.first_only,
        "second_only": paired.second_only,
        "difference": paired.difference,
        "ci95": list(paired.interval()),
        "p": paired.mcnemar(),
    }


def conditions_table(result: dict[str, Any]) -> str:
    """The comparison as lines."""
    wide = max(map(len, result["conditions"]))
    lines = [f"{result['policy']} on {result['task']}: success {result['definition']}"]
    for word, row in result["conditions"].items():
        lines.append(f"  {word:{wide}} {SuccessRate(row['success'], row['ci95'], row['n'])}")
    for row in result["comparisons"]:
        low, high = row["ci95"]
        lines.append(
            f"{row['first']} minus {row['second']}, paired by seed: {row['difference']:+.2f} "
            f"[{low:+.2f}, {high:+.2f}]   only {row['first']} {row['first_only']}, only "
            f"{row['second']} {row['second_only']} of {row['n']}   exact p = {row['p']:.2g}"
        )
    return "\n".join(lines)
