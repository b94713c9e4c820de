"""How long people wait: visitors of the page, students at their first cell, researchers at the
command line.

Each wait is measured from outside, and stands beside its floor: a Python that imports torch and the
simulator as any program does, and ends. With ``--before`` another checkout of madviz
takes turns, so ratios are of one run. For a suite, a visitor without a browser opens the page
(``visitor.py``):

    answers_s        from the command until the page answers
    first_picture_s  from the command until the first picture is there
    task_switch_s    from another task of the same suite until its first picture
    one_more_s       until the first picture of one visitor more, and one_more_mb of memory
    floor_s          imports of torch and the simulator alone

For *commands*, each one of ``COMMANDS`` runs to its end, in one process.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.memory import proportional_megabytes
from benchmarks.page_server import serving
from benchmarks.visitor import Visitor
from madviz.errors import UserError
from madviz.system.numbers import Count

PATIENCE = 120.0
SUITES = {
    "metaworld": (
        "metaworld-hammer-mad-light",
        "metaworld/push",
        "import torch, mujoco, metaworld",
    ),
    "maniskill": (
        "maniskill-push-cube-mad-light",
        "maniskill/pull-cube",
        "import torch, mani_skill.envs.tasks.tabletop",
    ),
}
"""The policy that is opened, the task that is chosen then, and the imports of both."""
HAMMER = SUITES["metaworld"][0]
FIRST_CELL = (
    "import madviz; from madviz import teaching; from madviz.widgets import Explorer; "
    f"teaching.moment_at(madviz.load_policy({HAMMER!r}), seed=2000, step=20)"
)
ONE_UPDATE = (
    "--light.demonstrations 1 --light.rounds 1 --light.episodes-per-round 1 "
    "--light.updates-per-round 1 --light.critic-updates 0"
)
COMMANDS = {
    "cell_s": ["-c", FIRST_CELL],
    "help_s": "-m madviz --help".split(),
    "list_s": "-m madviz list".split(),
    "eval_s": f"-m madviz eval --policy {HAMMER} --subsets all --episodes 1 --workers 0".split(),
    "train_s": (
        "-m madviz train --task metaworld/hammer --method mad --out OUT/trained " + ONE_UPDATE
    ).split(),
}
"""A student's first cell and a researcher's commands, as words of Python; OUT is a new folder."""


@dataclass(frozen=True)
class WaitsConfig:
    """Times what people wait for, for one suite, or for commands."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    suite: str = "metaworld"
    """metaworld, maniskill or commands."""
    rounds: Count = 5
    """How many times; the medians are given."""
    before: Path | None = None
    """Another checkout of madviz, which takes turns with this one."""


def bench_waits(config: WaitsConfig) -> dict[str, Any]:
    """``now``, with ``before`` beside it if asked: medians of the module's table. Raises UserError
    for an unknown suite, a ``before`` that is no checkout, and where no picture comes."""
    known = [*SUITES, "commands"]
    if config.suite not in known:
        raise UserError(f"expected a suite of {', '.join(known)}, found {config.suite!r}")
    commands = config.suite == "commands"
    measure = measured_commands if commands else partial(measured, config.suite)
    roots: dict[str, Path | None] = {"now": None}
    if config.before is not None:
        # Python would take the package of this checkout where the other folder has none.
        if not (config.before / "madviz/__main__.py").is_file():
            raise UserError(
                f"expected a checkout in {config.before}, found no madviz/__main__.py there; name "
                "the folder that holds madviz/"
            )
        roots["before"] = config.before
    found: dict[str, list[dict[str, float]]] = {name: [] for name in roots}
    for _ in range(config.rounds):
        for name, root in roots.items():
            found[name].append(measure(root))
    medians = {
        name: {key: round(statistics.median(one[key] for one in rounds), 3) for key in rounds[0]}
        for name, rounds in found.items()
    }
    return {"schema": 1, "suite": config.suite, "rounds": config.rounds, **medians}


def measured(suite: str, root: Path | None) -> dict[str, float]:
    """One start of the page of the checkout ``root``; None: of this one."""
    policy, other, imports = SUITES[suite]
    floor = _seconds_of(("-c", imports), None)
    began = time.monotonic()
    with serving(["--policy", policy, "--workers", "0"], root=root) as (url, process):
        answers = time.monotonic() - began
        with Visitor(url) as one:
            first = _until(lambda: bool(one.steps)) - began
            memory = proportional_megabytes(process.pid)
            began = time.monotonic()
            with Visitor(url) as second:
                more = _until(lambda: bool(second.steps)) - began
                _until(lambda: len(second.steps) > 2)
                more_mb = proportional_megabytes(process.pid) - memory
            task = one.find("Task")[0]
            began = time.monotonic()
            one.set(task, other)
            shown = _until(lambda: task not in one.controls and stands_at(one, other))
    return {
        "answers_s": answers,
        "first_picture_s": first,
        "task_switch_s": shown - began,
        "one_more_s": more,
        "one_more_mb": more_mb,
        "floor_s": floor,
    }


def measured_commands(root: Path | None) -> dict[str, float]:
    """Each of ``COMMANDS`` once, with the checkout ``root``; None: with this one."""
    with TemporaryDirectory() as out:
        found = {
            key: _seconds_of([word.replace("OUT", out) for word in words], root)
            for key, words in COMMANDS.items()
        }
    return {**found, "floor_s": _seconds_of(("-c", SUITES["metaworld"][2]), root)}


def _seconds_of(words: Sequence[str], root: Path | None) -> float:
    """Seconds until Python with ``words`` has ended. Raises CalledProcessError where it fails."""
    began = time.monotonic()
    subprocess.run([sys.executable, *words], check=True, capture_output=True, cwd=root)
    return time.monotonic() - began


def stands_at(visitor: Visitor, task: str) -> bool:
    """True where a choice of tasks on the page stands at ``task``."""
    return any(visitor.controls[one]["value"] == task for one in visitor.find("Task"))


def _until(there: Callable[[], bool]) -> float:
    """When ``there`` became true. Raises UserError where it does not."""
    deadline = time.monotonic() + PATIENCE
    while not there():
        if time.monotonic() > deadline:
            raise UserError(f"expected a picture within {PATIENCE:g} s, found none")
        time.sleep(0.01)
    return time.monotonic()
