"""Trainings of a lesson: real ones, small on ``toy/reach`` or of the light recipe's own size.

They are saved in a folder, and what is there already is not trained again: a lesson that is run a
second time has its policies at once.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from madviz.errors import Interrupted, UserError
from madviz.policies import checkpoint
from madviz.system.files import read_rows
from madviz.teaching.episode import begin
from madviz.types import Policy, PolicySpec

if TYPE_CHECKING:
    from madviz.training.light import LightConfig


@dataclass(frozen=True)
class SmallRun:
    """A training of a lesson."""

    folder: Path
    policy: Policy
    seconds: float
    """Wall time; 0 where it was there already."""
    curve: tuple[Mapping[str, Any], ...]
    """One row per round, as in curve.csv."""

    @property
    def spec(self) -> PolicySpec:
        return self.policy.spec


def train_small(
    method: str,
    *,
    rounds: int = 8,
    updates: int = 100,
    critic: int = 100,
    batch: int = 32,
    camera: str = "",
    task: str = "toy/reach",
    folder: Path | str | None = None,
    seed: int = 1,
) -> SmallRun:
    """Trains ``method`` with the light recipe and small numbers: about a minute on ``toy/reach``.

    ``rounds`` of ``updates`` shape what the policy does, ``critic`` updates the Q it shows; each
    has ``batch`` samples. For the rest see ``train_light``.
    """
    from madviz.training.light import LightConfig

    light = LightConfig(rounds=rounds, updates_per_round=updates, batch_size=batch, hidden_dim=128)
    light = replace(light, critic_updates=critic)
    return train_light(task, method, light, camera=camera, folder=folder, seed=seed)


def train_light(
    task: str,
    method: str,
    light: LightConfig | None = None,
    *,
    camera: str = "",
    folder: Path | str | None = None,
    seed: int = 1,
) -> SmallRun:
    """Trains with the light recipe, as ``madviz train`` does; ``light`` None is its own size.

    A run that is there already is loaded and not repeated, and one that was interrupted is resumed.
    ``folder`` is where runs are saved, by default a temporary one of this machine, or of this user
    where that one belongs to somebody else and does not have the run yet. Raises UserError
    for unknown names, and where the training is stopped before its end.
    """
    from madviz.sweep.run import trained
    from madviz.training.config import TrainConfig, resolve
    from madviz.training.light import LightConfig
    from madviz.training.train import train

    begin()
    light = light or LightConfig()
    config = TrainConfig(task=task, method=method, camera=camera, seed=seed, light=light)
    own = sha256(repr(light).encode()).hexdigest()[:6]
    name = f"{resolve(config).spec.name}-{light.rounds}x{light.updates_per_round}-{own}-{seed}"
    out = Path(folder) / name if folder else _own_folder(name)
    began = time.monotonic()
    done = trained(out)
    if not done:
        resume = (out / "resume" / "run.json").exists()
        with suppress(Interrupted):
            train(replace(config, out=out, resume=resume), _say)
        if not trained(out):
            raise UserError(
                "expected a finished training, found one that was stopped; "
                "run the cell again to resume it"
            )
    seconds = 0.0 if done else time.monotonic() - began
    return SmallRun(out, checkpoint.load_policy(out), seconds, _read_curve(out / "curve.csv"))


def _say(event: dict[str, Any]) -> None:
    """Progress in one line that grows."""
    if event["kind"] == "curve":
        minutes = round(event["seconds_left"] / 60)
        left = f" ({minutes} min to go)" if minutes > 1 else ""
        print(f"round {event['round']}: loss {event['loss']:.3f}{left}", end="  ", flush=True)


def _own_folder(name: str) -> Path:
    """The place of the run ``name`` in the folder for temporary files, which users may share."""
    from madviz.sweep.run import trained

    shared = Path(tempfile.gettempdir()) / "madviz-lessons"
    if not shared.exists() or os.access(shared, os.W_OK) or trained(shared / name):
        return shared / name
    return shared.with_name(f"{shared.name}-{os.getuid()}") / name


def _read_curve(file: Path) -> tuple[Mapping[str, Any], ...]:
    return tuple(
        {key: float(value or "nan") for key, value in row.items()} for row in read_rows(file)
    )
