"""Trainings that end, or are stopped, and the state they leave."""

from __future__ import annotations

import csv
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

from madviz.errors import Interrupted
from madviz.runs.run_folder import Event, RunFolder
from madviz.training.config import TrainConfig, identity, resolve
from madviz.training.train import train


def facts_of(config: TrainConfig) -> dict[str, Any]:
    """The facts that a resumed run must share."""
    return identity(config, resolve(config))


def last_state(config: TrainConfig, listener: Any = None) -> dict[str, Any]:
    """Trains as ``madviz train`` does; the last state, which stays to be compared."""
    assert config.out is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "finish", lambda self: None)
        with suppress(Interrupted):
            train(config, listener or (lambda event: None))
    return torch.load(config.out / "resume" / "state.pt", weights_only=True)


def stops_at(step: int, kind: str = "progress") -> Callable[[Event], None]:
    """A listener that presses Ctrl-C when a run says that it is at ``step``."""

    def interrupt(event: Event) -> None:
        if event["kind"] == kind and event["step"] == step:
            os.kill(os.getpid(), signal.SIGINT)

    return interrupt


def curve(folder: Path) -> list[dict[str, str]]:
    """The curve without its clock."""
    with (folder / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    clock = [k for k in rows[0] if k.startswith("seconds") or k.endswith("per_s")]
    return [{k: v for k, v in row.items() if k not in clock} for row in rows]


def assert_same_run(one: dict[str, Any], other: dict[str, Any]) -> None:
    """Two last states are of one run: weights, random numbers and everything that is counted."""
    for name, weight in one["learner"]["agent"].items():
        assert torch.equal(weight, other["learner"]["agent"][name]), name
    assert one["learner"].get("rng") == other["learner"].get("rng")
    drawn = {"generator", "noise"} & {*one["learner"]}  # By recipe.
    assert drawn
    for key in drawn:
        assert torch.equal(one["learner"][key], other["learner"][key]), key
    counted = ("step", "updates", "episodes", "rng", "episode_seeds")
    in_some_recipes = {"drawn", "losses"} & {*one, *other}
    for key in (*counted, *in_some_recipes):
        assert one[key] == other[key], key
