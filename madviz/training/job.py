"""Training in a process of its own, started, stopped, resumed and watched from elsewhere.

A page must not stand still while something learns, and a training must not end because a page does
something wrong. So a job is ``madviz train`` as a child process that lets all others go first, and
all that this module knows of it comes from the run's folder: rows of ``curve.csv``, the policy once
it is there, and the last line of its log where it failed. A job that was stopped resumes exactly.

    start ── running ── (stop) ── stopped ── (resume) ── running ── done
                 └──────────────── failed, with the reason

``snapshot`` copies the policy as it stands, because the run goes on writing to its folder, and what
is being watched must not change under those who watch it. One job at a time.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from madviz.agent.methods import method
from madviz.envs.registry import check_task
from madviz.errors import UserError, unknown
from madviz.system.files import new_folder, read_rows, write_json
from madviz.system.priority import lowest_priority

State = Literal["idle", "running", "stopping", "stopped", "failed", "done"]


@dataclass(frozen=True)
class Offer:
    """How a page offers a recipe; no torch is loaded for it."""

    words: str
    """Says what it does, and how long that takes."""
    budgets: dict[str, tuple[str, ...]]
    """Words that are added to the command, by name; nothing stands for the recipe's defaults."""


FULL_LIGHT = "--light.rounds 30 --light.updates-per-round 500 --light.alpha 0.25"
OFFERS = {
    "light": Offer(
        "imitates a scripted expert; minutes",
        {
            "trial": ("--light.rounds", "4", "--light.critic-updates", "500"),
            "short": (),
            "full": tuple(FULL_LIGHT.split()),
        },
    ),
    "paper": Offer(
        "reinforcement learning from scratch; hours to days here",
        {
            "trial": ("--paper.steps", "5000", "--paper.buffer-capacity", "5000"),
            "short": ("--paper.steps", "50000", "--paper.buffer-capacity", "50000"),
            "full": (),
        },
    ),
    "mv-mwm": Offer(
        "reinforcement learning in the imagination of a world model; hours here",
        {
            "trial": ("--mv-mwm.steps", "3000", "--mv-mwm.exploration-steps", "1000"),
            "short": (),
            "full": ("--mv-mwm.steps", "100000"),
        },
    ),
}
POLICY_FILES = ("config.json", "weights.safetensors")
STOPPED = tuple(
    code for number in (signal.SIGINT, signal.SIGTERM) for code in (128 + number, -number)
)
"""Exit codes of a training that a signal stopped, after it saved or before it began."""
DIGITS = 8
"""Digits of the weights' hash in the name of a copy."""
LOG_END = 500
"""Characters of a log's end that may be shown."""


@dataclass(frozen=True)
class JobConfig:
    """The training that is asked for. Raises UserError for a name that is not known."""

    task: str
    method: str = "mad"
    recipe: str = "light"
    budget: str = "trial"

    def __post_init__(self) -> None:
        check_task(self.task)
        recipes = [recipe for recipe in method(self.method).recipes if recipe in OFFERS]
        if self.recipe not in recipes:
            raise unknown(f"recipe of {self.method}", self.recipe, recipes)
        if self.budget not in OFFERS[self.recipe].budgets:
            raise unknown("budget", self.budget, list(OFFERS[self.recipe].budgets))

    def words(self) -> list[str]:
        """The arguments of ``madviz train``, without the folder."""
        named = {"task": self.task, "method": self.method, "recipe": self.recipe}
        words = [word for name, value in named.items() for word in (f"--{name}", value)]
        return ["train", *words, *OFFERS[self.recipe].budgets[self.budget]]


@dataclass(frozen=True)
class JobStatus:
    """The state of the job at one time."""

    state: State = "idle"
    config: JobConfig | None = None
    rows: tuple[dict[str, float], ...] = ()
    """The rows of ``curve.csv``, oldest first; NaN where a cell is empty."""
    folder: Path | None = None
    ready: bool = False
    """Whether there is a policy to watch."""
    why: str = ""
    """The last line of the log of a job that failed, or was stopped: the command to go on."""

    @property
    def seconds_left(self) -> float:
        return self.rows[-1].get("seconds_left", math.nan) if self.rows else math.nan

    @property
    def done(self) -> float:
        """Share of the job that is done, in [0, 1]."""
        if self.state == "done":
            return 1.0
        spent = self.rows[-1].get("seconds", 0.0) if self.rows else 0.0
        whole = spent + self.seconds_left
        return spent / whole if math.isfinite(whole) and whole > 0 else 0.0


class TrainingJob:
    """See the module. Everybody may call everything; ``close`` stops the child."""

    def __init__(self, root: Path, program: tuple[str, ...] = (sys.executable, "-m", "madviz")):
        """Runs get folders of their own in ``root``. ``program`` is what ``train`` is given to."""
        self._root = root
        self._program = program
        self._lock = threading.Lock()
        self._child: subprocess.Popen | None = None
        self._config: JobConfig | None = None
        self._folder: Path | None = None
        self._stopping = False

    def start(self, config: JobConfig) -> None:
        """Raises UserError if a job is running."""
        with self._lock:
            self._must_rest()
            self._config = config
            self._folder = self._free_folder(config)
            self._launch(())

    def resume(self) -> None:
        """Goes on with the job that was stopped. Raises UserError if there is none."""
        with self._lock:
            self._must_rest()
            if self._folder is None or self._state() not in ("stopped", "failed"):
                raise UserError("expected a training that was stopped, found none; start one")
            began = (self._folder / "resume" / "run.json").exists()
            self._launch(("--resume",) if began else ())

    @property
    def pid(self) -> int | None:
        """The process that trains, or trained last."""
        return self._child.pid if self._child is not None else None

    def stop(self) -> None:
        """Asks the child to keep its state and end; it does so after its present round."""
        with self._lock:
            if self._child is not None and self._child.poll() is None:
                self._stopping = True
                # Not SIGINT: a process that a shell started in the background ignores it.
                self._child.send_signal(signal.SIGTERM)

    def status(self) -> JobStatus:
        with self._lock:
            if self._config is None or self._folder is None:
                return JobStatus()
            state = self._state()
            return JobStatus(
                state,
                self._config,
                _rows(self._folder / "curve.csv"),
                self._folder,
                all((self._folder / name).exists() for name in POLICY_FILES),
                self._why() if state in ("failed", "stopped") else "",
            )

    def snapshot(self) -> Path:
        """A copy of the newest policy, named after its weights: it must not be taken for the
        finished one of the same task, nor for what the run saves next. The same weights are the
        same copy. Raises UserError before there is one."""
        status = self.status()
        if status.folder is None or not status.ready:
            raise UserError("expected a policy to watch, found none yet; the first comes soon")
        config, weights = POLICY_FILES
        learned = (status.folder / weights).read_bytes()
        digest = hashlib.sha256(learned).hexdigest()[:DIGITS]
        copy = status.folder / "watched" / f"{status.folder.name}-{digest}"
        with self._lock:  # Two visitors may ask at once.
            if not copy.exists():
                copy.parent.mkdir(exist_ok=True)
                described = json.loads((status.folder / config).read_text())
                with new_folder(copy) as part:
                    (part / weights).write_bytes(learned)
                    write_json(part / config, {**described, "name": copy.name})
        return copy

    def close(self) -> None:
        """Ends the child, if it must be without its present round."""
        self.stop()
        child = self._child
        if child is not None:
            try:
                child.wait(2.0)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()

    def _must_rest(self) -> None:
        if self._child is not None and self._child.poll() is None:
            raise UserError("a training is running already; stop it first, or wait for it")

    def _free_folder(self, config: JobConfig) -> Path:
        name = f"{config.task.replace('/', '-')}-{config.method}-{config.recipe}"
        taken = (self._root / f"{name}-{number}" for number in range(1, 10_000))
        return next(folder for folder in taken if not folder.exists())

    def _launch(self, more: tuple[str, ...]) -> None:
        assert self._config is not None and self._folder is not None
        self._folder.mkdir(parents=True, exist_ok=True)
        self._stopping = False
        words = [*self._program, *self._config.words(), "--out", str(self._folder), *more]
        with (self._folder / "log.txt").open("ab") as log:
            self._child = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                start_new_session=True,
            )
        # From here and not between fork and exec, where a process with threads may hang.
        lowest_priority(self._child.pid)

    def _state(self) -> State:
        code = self._child.poll() if self._child is not None else None
        if self._child is None:
            return "idle"
        if code is None:
            return "stopping" if self._stopping else "running"
        if code == 0:
            return "done"
        return "stopped" if self._stopping or code in STOPPED else "failed"

    def _why(self) -> str:
        assert self._folder is not None
        code = self._child.poll() if self._child is not None else None
        if code is not None and code < 0 and code not in STOPPED:  # It could not say anything.
            name = signal.Signals(-code).name
            hint = ", as a system does that has no memory left" if code == -signal.SIGKILL else ""
            return f"it was ended by {name}{hint}; go on resumes from what was saved last"
        log = (self._folder / "log.txt").read_text(errors="replace").strip()
        return log.splitlines()[-1][-LOG_END:] if log else "it left no word"


def _rows(file: Path) -> tuple[dict[str, float], ...]:
    """Numbers of a curve that is being written."""
    return tuple({key: _number(value) for key, value in row.items()} for row in read_rows(file))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
