"""Measured policies, read from their folders: config.json, evaluation.json, development.json.

Weights may be missing (a policy that only serves a table leaves them out), so this is not the way
to load a policy. Where they are there, the evaluation must be of them; and always its rates must be
those of its own episodes, so that a number typed by hand is noticed.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from madviz.agent.methods import METHODS
from madviz.errors import UserError
from madviz.policies import checkpoint
from madviz.policies.config import PolicyConfig, read_config
from madviz.policies.listing import BrokenRow
from madviz.policies.measured import EvaluationFile, as_evaluation
from madviz.policies.seeds import MEASURED, use_of
from madviz.subsets import mask_of
from madviz.system.files import read_json

Outcomes = Mapping[int, bool]
"""Success at the last step, by seed."""


@dataclass(frozen=True)
class Evidence:
    """One trained policy and how its episodes went."""

    path: Path
    config: PolicyConfig
    occlusions: str
    outcomes: Mapping[str, Outcomes]
    """By subset, as the evaluation file names them."""
    development: Mapping[str, Outcomes]
    """As ``outcomes``, from development.json; empty without that file."""
    outside: Mapping[str, float]
    """By subset of ``outcomes``, the share of action numbers outside [-1, 1]; they were clipped."""
    development_outside: Mapping[str, float]
    """As ``outside``, from development.json."""

    @property
    def command(self) -> str:
        """The command line that trains it again; '' where the config does not say."""
        return self.config.training.command or ""

    @property
    def own_cameras(self) -> bool:
        """True where it has cameras of the user's in place of its setting's."""
        return "--cameras" in self.command.split()

    @property
    def method(self) -> str:
        """The method, and its merge where that is not the usual one."""
        name = self.config.method
        usual = METHODS[name].merge if name in METHODS else "sum"
        return name if self.config.merge == usual else f"{name} with {self.config.merge}"

    @property
    def alpha(self) -> float | None:
        """The alpha of the training; None where its method has fixed weights, whatever an older
        file says."""
        known = METHODS.get(self.config.method)
        said = self.config.training.alpha
        return known.alpha_of(said) if known and said is not None else said

    @property
    def seed(self) -> int:
        """The seed of the training, which is 1 where the command does not say."""
        words = shlex.split(self.command)
        try:
            return int(words[words.index("--seed") + 1])
        except (ValueError, IndexError):
            return 1

    @property
    def seeds(self) -> str:
        """The use of its episodes' seeds, see seeds.py."""
        return use_of(seed for found in self.outcomes.values() for seed in found)

    def on(self, use: str) -> Evidence | None:
        """The same policy on seeds of ``use``; None if it was not measured there."""
        earlier = replace(
            self, outcomes=self.development, development={}, outside=self.development_outside
        )
        return next((each for each in (self, earlier) if each.seeds == use), None)

    @property
    def folder(self) -> str:
        """The folder's name; of a sweep's run, where every policy's folder is called the same, the
        run's."""
        return self.path.parent.name if self.path.name == checkpoint.IN_RUN else self.path.name

    def of(self, subset: str) -> Outcomes | None:
        """Outcomes of ``subset`` under whatever name: for a policy with one camera, that camera's
        name is ``all``. None if it was not measured."""
        name = self.name_there(subset)
        return None if name is None else self.outcomes[name]

    def name_there(self, subset: str) -> str | None:
        """The name of ``subset`` in ``outcomes``, None if it was not measured."""
        if subset in self.outcomes:
            return subset
        try:
            mask = mask_of(subset, self.config.streams)
            for name in self.outcomes:
                if np.array_equal(mask, mask_of(name, self.config.streams)):
                    return name
        except UserError:
            pass  # A camera that this policy does not have.
        return None

    @property
    def first_seed(self) -> int:
        """The lowest seed of all episodes."""
        return min(seed for found in self.outcomes.values() for seed in found)

    @property
    def episodes(self) -> int:
        """Episodes of each subset; the largest number where they differ."""
        return max(len(found) for found in self.outcomes.values())


def read_evidence(folder: str | Path) -> Evidence:
    """Raises UserError for files that are missing, or contradict each other."""
    path = Path(folder)
    config, _ = read_config(path / checkpoint.CONFIG)
    evaluation = _read(path, checkpoint.EVALUATION)
    earlier = (path / checkpoint.DEVELOPMENT).is_file()
    development = _read(path, checkpoint.DEVELOPMENT) if earlier else None
    return Evidence(
        path=path,
        config=config,
        occlusions=evaluation["occlusions"],
        outcomes=_outcomes(path / checkpoint.EVALUATION, evaluation),
        development=_outcomes(path / checkpoint.DEVELOPMENT, development) if development else {},
        outside=_outside(evaluation),
        development_outside=_outside(development) if development else {},
    )


def _read(path: Path, name: str) -> EvaluationFile:
    if (path / checkpoint.WEIGHTS).is_file():
        return checkpoint.own_evaluation(checkpoint.describe(path), name)
    return as_evaluation(read_json(path / name), path / name)


def alike(found: Sequence[Evidence]) -> list[Evidence]:
    """Policies that can be compared: on seeds of the use that most of them have, the first such in
    ``MEASURED``; others are left out."""
    shared = [[each for one in found if (each := one.on(use))] for use in MEASURED]
    return max(shared, key=len)


def find_evidence(*roots: str | Path) -> tuple[list[Evidence], list[BrokenRow]]:
    """Every policy under ``roots``, at any depth, that was evaluated; root after root, each in the
    order of paths. And those whose files are broken or contradict each other, with why."""
    folders = [f.parent for root in roots for f in sorted(Path(root).rglob(checkpoint.CONFIG))]
    return readable([f for f in folders if (f / checkpoint.EVALUATION).is_file()])


def readable(folders: Iterable[Path]) -> tuple[list[Evidence], list[BrokenRow]]:
    """The evidence of every folder that can be read, and of the others why they cannot."""
    found: list[Evidence] = []
    broken: list[BrokenRow] = []
    for folder in folders:
        try:
            found.append(read_evidence(folder))
        except UserError as error:
            broken.append({"name": folder.name, "path": str(folder), "error": str(error)})
    return found, broken


def _outside(evaluation: EvaluationFile) -> dict[str, float]:
    return {name: row.get("outside", 0.0) for name, row in evaluation["subsets"].items()}


def _outcomes(file: Path, evaluation: EvaluationFile) -> dict[str, dict[int, bool]]:
    found: dict[str, dict[int, bool]] = {name: {} for name in evaluation["subsets"]}
    for episode in evaluation["episodes"]:
        if episode["subset"] not in found:
            raise UserError(
                f"{file}: expected episodes of {', '.join(found)}, found one of "
                f"{episode['subset']!r}; evaluate again"
            )
        found[episode["subset"]][episode["seed"]] = episode["success"]
    for name, row in evaluation["subsets"].items():
        rate = row["success"]
        n = row["n"]
        outcomes = found[name]
        counted = sum(outcomes.values()) / len(outcomes) if outcomes else None
        if n != len(outcomes) or counted is None or abs(counted - rate) > 1e-9:
            raise UserError(
                f"{file}: expected the rate of {name} to be that of its episodes, found {rate} "
                f"(n={n}) and {counted} (n={len(outcomes)}); evaluate again"
            )
    return found
