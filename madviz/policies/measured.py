"""evaluation.json and development.json of a policy folder: what ``madviz eval --card`` measured.

The types are dictionaries, because the file, ``--json`` and ``madviz.evaluate(...).rows`` are one
and the same document.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict

from madviz.policies.seeds import use_of
from madviz.system.typed import typed

FIX = "evaluate again with `madviz eval --card`"


class SubsetRow(TypedDict):
    """What the episodes of one subset came to."""

    success: float
    """Rate at the last step."""
    success_any: float
    """Rate at any step."""
    n: int
    """Episodes."""
    ci95: list[float]
    """Wilson's interval of ``success``."""
    trained: bool
    """Whether the policy was trained on the subset."""


EpisodeRow = TypedDict(
    "EpisodeRow",
    {"subset": str, "seed": int, "success": bool, "success_any": bool, "return": float},
)
"""One episode; ``return`` is the sum of its rewards."""


class EvaluationFile(TypedDict):
    """The whole document."""

    schema: int
    policy: str
    digest: str
    """Of the weights and config that were measured."""
    task: str
    definition: str
    """What counts as a success."""
    render_profile: str
    occlusions: str
    """'' where no camera was occluded."""
    seed: int
    """The first episode's; what seeds serve is in seeds.py."""
    subsets: dict[str, SubsetRow]
    episodes: list[EpisodeRow]


def seeds_of(evaluation: EvaluationFile) -> str:
    """What its seeds serve, see ``use_of``."""
    return use_of(episode["seed"] for episode in evaluation["episodes"])


def as_evaluation(document: object, file: Path) -> EvaluationFile:
    """What ``file`` holds. Raises UserError where that is no evaluation."""
    return typed(document, EvaluationFile, file, FIX)
