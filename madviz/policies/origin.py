"""origin.json of a policy folder: what the training itself could not know of the policy.

    {"best_of": 2}                       a person chose it among two trainings
    {"script_before": "00ab0ab1"}        the script that taught it was changed with this revision

It is beside config.json and not in it, because the digest names weights and config, and these
words change neither. Most folders have no such file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from madviz.system.files import read_json
from madviz.system.typed import typed

ORIGIN = "origin.json"


class Origin(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The file's content; at least one of both."""

    best_of: Annotated[int, Meta(ge=2)] | None = None
    """Trainings with one command, but for their seeds, among which it was chosen."""
    script_before: Annotated[str, Meta(pattern="^[0-9a-f]{7,40}$")] | None = None
    """The revision of this repository that changed the script: the command in the card now
    trains on another one."""

    def __post_init__(self) -> None:
        if self.best_of is None and self.script_before is None:
            raise ValueError("expected best_of or script_before, found neither")

    @property
    def choice(self) -> str:
        """``the better of two trainings``; '' where nothing was chosen."""
        if self.best_of is None:
            return ""
        if self.best_of == 2:
            return "the better of two trainings"
        return f"the best of {self.best_of} trainings"

    @property
    def script(self) -> str:
        """How the script differs from today's; '' where it is today's."""
        if self.script_before is None:
            return ""
        return (
            f"as it was before revision `{self.script_before}`; with today's, the command above "
            "gives another policy"
        )


def origin_of(folder: Path) -> Origin | None:
    """The origin of the policy in ``folder``; None where no file is. Raises UserError for a file
    that says anything else."""
    file = folder / ORIGIN
    if not file.is_file():
        return None
    return typed(read_json(file), Origin, file, "restore the file, or remove it")
