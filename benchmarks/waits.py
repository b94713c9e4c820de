"""How long a visitor waits: from the command to the first picture, for another task, as one visitor
more.

Each is measured from outside, as a visitor without a browser has it (``soak/visitor.py``), and
stands beside its floor: what no code of ours avoids, a Python that imports torch and the simulator
and ends. With ``--before`` another checkout of madviz takes turns, so ratios are of one run.

    answers_s        from the command until the page answers
    first_picture_s  from the command until the first picture is there
    task_switch_s    from another task of the same suite until its first picture
    one_more_s       until the first picture of one visitor more, and one_more_mb of memory
    floor_s          imports of torch and the simulator alone
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from madviz.errors import UserError
from madviz.soak.memory import proportional_megabytes
from madviz.soak.server import serving
from madviz.soak.visitor import Visitor
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


@dataclass(frozen=True)
class WaitsConfig:
    """Times what a visitor waits for, for one suite."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    suite: str = "metaworld"
    """metaworld or maniskill."""
    rounds: Count = 5
    """How many times; the medians are given."""
    before: Path | None = None
    """Another checkout of madviz, which takes turns with this one."""


def bench_waits(config: WaitsConfig) -> dict[str, Any]:
    """``now``, with ``before`` beside it if asked: medians of the module's table. Raises UserError
    for an unknown suite and where no picture comes."""
    if config.suite not in SUITES:
        raise UserError(f"expected a suite of {', '.join(SUITES)}, found {config.suite!r}")
    roots: dict[str, Path | None] = {"now": None}
    if config.before is not None:
        roots["before"] = config.before
    found: dict[str, list[dict[str, float]]] = {name: [] for name in roots}
    for _ in range(config.rounds):
        for name, root in roots.items():
            found[name].append(measured(config.suite, root))
    medians = {
        name: {key: round(statistics.median(one[key] for one in rounds), 2) for key in rounds[0]}
        for name, rounds in found.items()
    }
    return {"schema": 1, "suite": config.suite, "rounds": config.rounds, **medians}


def measured(suite: str, root: Path | None) -> dict[str, float]:
    """One start of the page of the checkout ``root``; None: of this one."""
    policy, other, imports = SUITES[suite]
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", imports], check=True, capture_output=True)
    floor = time.monotonic() - began
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
