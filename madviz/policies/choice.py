"""choice.json of a policy folder: among how many trainings a person chose this policy.

    {"best_of": 2}

It is beside config.json and not in it, because the digest names weights and config, and a choice
changes neither. Most folders have no such file: they were not chosen among several trainings.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from madviz.system.files import read_json
from madviz.system.typed import typed

CHOICE = "choice.json"


class BestOf(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The file's content."""

    best_of: Annotated[int, Meta(ge=2)]
    """Trainings with one command, but for their seeds."""

    def __str__(self) -> str:
        if self.best_of == 2:
            return "the better of two trainings"
        return f"the best of {self.best_of} trainings"


def choice_of(folder: Path) -> BestOf | None:
    """The choice of the policy in ``folder``; None where there was none. Raises UserError for a
    file that says anything else."""
    file = folder / CHOICE
    if not file.is_file():
        return None
    return typed(read_json(file), BestOf, file, "restore the file, or remove it")
