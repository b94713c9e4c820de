"""evaluation.json and development.json of a policy folder: what ``madviz eval --card`` measured.

The types are dictionaries, because the file, ``--json`` and ``madviz.evaluate(...).rows`` are one
and the same document.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NotRequired, TypedDict

from msgspec import Meta

from madviz.policies.seeds import use_of
from madviz.system.typed import typed

FIX = "restore it, or remove it and run `madviz eval --card`"


Rate = Annotated[float, Meta(ge=0, le=1)]
Seed = Annotated[int, Meta(ge=0, le=2**62)]


class RateRow(TypedDict):
    """A success rate as documents hold it."""

    success: float
    n: int
    """Episodes."""
    ci95: list[float]
    """Wilson's interval of ``success``."""


class SubsetRow(TypedDict):
    """The success rates of one subset."""

    success: Rate
    """At the last step."""
    success_any: Rate
    """At any step."""
    n: Annotated[int, Meta(ge=1, le=2**31)]
    """Episodes."""
    ci95: Annotated[list[Rate], Meta(min_length=2, max_length=2)]
    """Wilson's interval of ``success``."""
    trained: bool
    """Whether the policy was trained on the subset."""
    outside: NotRequired[Rate]
    """The share of action numbers outside [-1, 1]; they were clipped."""


EpisodeRow = TypedDict(
    "EpisodeRow",
    {"subset": str, "seed": Seed, "success": bool, "success_any": bool, "return": float},
)
"""One episode; ``return`` is the sum of its rewards."""


class EvaluationFile(TypedDict):
    """The whole document."""

    schema: int
    policy: str
    digest: str
    """The digest of the weights and config that were measured."""
    task: str
    definition: str
    """The task's definition of a success."""
    render_profile: str
    occlusions: str
    """'' where no camera was occluded."""
    guard: NotRequired[str]
    """A sentence on the guard; no such word without one."""
    seed: Seed
    """The first episode's; what seeds serve is in seeds.py."""
    subsets: Annotated[dict[str, SubsetRow], Meta(min_length=1)]
    episodes: Annotated[list[EpisodeRow], Meta(min_length=1)]


def seeds_of(evaluation: EvaluationFile) -> str:
    """The use of its seeds, see ``use_of``."""
    return use_of(episode["seed"] for episode in evaluation["episodes"])


def as_evaluation(document: object, file: Path) -> EvaluationFile:
    """``document``, read from ``file``. Raises UserError where it is no evaluation."""
    return typed(document, EvaluationFile, file, FIX)
