"""``train``: one way in for every recipe; a plan, a run folder, and the recipe's own loop.

    light              minutes on two cores, by imitating an expert   training/light.py
    paper              the paper's losses, one environment            training/paper.py
    paper-vectorised   the same losses over many environments         training/vectorised.py
    mv-mwm             an actor-critic in a world model's imagination world_model/recipe.py

The folder given with --out is a policy folder from the first checkpoint on: explore it, evaluate
it, copy it to checkpoints/. Ctrl-C finishes the round, saves, and says how to go on."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable
from pathlib import Path

import torch

from madviz.errors import Interrupted, signal_of
from madviz.runs.run_folder import Event, RunFolder, alone_in, not_written, of_writing
from madviz.runs.training_plan import TrainingPlan
from madviz.system.numbers import check_numbers
from madviz.system.processes import reuse_large_blocks
from madviz.system.streams import say
from madviz.training.config import (
    RECIPES,
    TrainConfig,
    command,
    identity,
    learner_threads,
    resolve,
    with_recording,
)


def train(config: TrainConfig, listener: Callable[[Event], None] | None = None) -> Path:
    """Trains and returns the policy's folder. Events go to ``listener``, by default one line each
    on standard error. Raises UserError for unknown names and for a folder that holds another run
    or in which another process trains. A Ctrl-C or SIGTERM saves, then raises
    Interrupted with the command to go on."""
    try:
        return _train(config, listener)
    except Interrupted:
        raise
    except KeyboardInterrupt as stopped:
        raise Interrupted("", signal_of(stopped)) from stopped


def _train(config: TrainConfig, listener: Callable[[Event], None] | None) -> Path:
    check_numbers(config)
    config = with_recording(config)
    plan = resolve(config)
    reuse_large_blocks()
    torch.set_num_threads(learner_threads(config))
    out = config.out or Path("runs") / plan.spec.name
    facts = identity(config, plan)
    try:
        with alone_in(out):
            folder = RunFolder(out, facts, config.resume, listener or print_event)
            _work(config, plan, folder)
    except OSError as error:
        if not of_writing(error, out):
            raise
        raise not_written(out, error) from error
    return folder.path


def _work(config: TrainConfig, plan: TrainingPlan, folder: RunFolder) -> None:
    if folder.finished:
        folder.finish()  # Again: the first time may have been cut off.
        folder.report("done", seconds=0.0, path=str(folder.path))
        return
    recipe = RECIPES[config.recipe]
    began = time.monotonic()
    again = command(config, given_away=False)
    goes_on = f"{again} {shlex.join(['--out', str(folder.path), '--resume'])}"
    try:
        recipe.train(plan, getattr(config, recipe.options), folder)
    except Exception:
        folder.forget()
        raise
    except KeyboardInterrupt as stopped:  # Before its loop, or a second one.
        folder.forget()
        if folder.began:
            raise Interrupted(goes_on, signal_of(stopped)) from stopped
        raise
    if folder.stopped_by and not folder.finished:
        raise Interrupted(goes_on, folder.stopped_by)
    folder.report("done", seconds=round(time.monotonic() - began, 1), path=str(folder.path))


def print_event(event: Event) -> None:
    """One line on standard error."""
    words = [f"{key} {value}" for key, value in event.items() if key != "kind"]
    say("  ".join([f"[{event['kind']}]", *words]))
