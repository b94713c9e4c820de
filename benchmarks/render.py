"""Ratios measured in one run: what a claim about speed in the README is made of.

Milliseconds drift with the machine and with whatever else it does; a ratio of two things that take
turns in one process does not. So both sides alternate, the order flips every round, and medians are
compared. The other benchmarks lie beside this file.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from benchmarks.stock import stock_frames
from madviz.envs.registry import TaskName, make_env
from madviz.errors import UserError
from madviz.system.numbers import Count, Pixels

OUR_FLAGS = "profile fast: no shadows, reflections or samples, lighter meshes; colour and depth"
STOCK = {"metaworld": "MuJoCo's and the model's", "maniskill": "ManiSkill's"}
"""Suites that have a stock renderer to be measured against, and whose settings that has."""
SUITE_TASK = {"metaworld": "metaworld/hammer", "maniskill": "maniskill/push-cube"}


@dataclass(frozen=True)
class RenderConfig:
    """Times a three-view frame against the simulator as its users draw it."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    task: TaskName = "metaworld/hammer"
    """A task of Meta-World or ManiSkill."""
    suite: Literal["metaworld", "maniskill"] | None = None
    """Short for a task of this suite: ``metaworld/hammer``, ``maniskill/push-cube``."""
    size: Pixels = 84
    """Rows and columns of a view, pixels."""
    rounds: Count = 15
    """Frames drawn by each side; the medians are compared."""


class Frames(Protocol):
    """Something that moves on a step and draws three views."""

    def step(self) -> None: ...

    def draw(self) -> list[Any]: ...

    def close(self) -> None: ...


class OurFrames:
    """The three views as madviz draws them, colour and depth."""

    def __init__(self, task: str, size: int) -> None:
        self._env = make_env(task)
        self._size = size
        self._env.reset(seed=0)
        self._idle = np.zeros(self._env.spec.action_dim, np.float32)

    def step(self) -> None:
        self._env.step(self._idle)

    def draw(self) -> list[Any]:
        return [self._env.view(camera.name, self._size) for camera in self._env.spec.cameras]

    def close(self) -> None:
        self._env.close()


def alternate(
    sides: dict[str, Frames], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Median milliseconds of ``draw`` by side, after one round that does not count. Every round
    steps and draws each side once, in an order that flips from round to round."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for number in range(rounds + 1):
        for name in sorted(sides, reverse=number % 2 == 1):
            sides[name].step()
            started = clock()
            sides[name].draw()
            times[name].append(1000 * (clock() - started))
    return {name: statistics.median(each[1:]) for name, each in times.items()}


def bench_render(config: RenderConfig) -> dict[str, Any]:
    """``ours_ms``, ``stock_ms`` and their ``ratio``, with the flags of both sides."""
    task = SUITE_TASK[config.suite] if config.suite else config.task
    suite = task.split("/")[0]
    if suite not in STOCK:
        raise UserError(
            f"expected a task metaworld/… or maniskill/…, found {task!r}; see `madviz list`"
        )
    ours = OurFrames(task, config.size)
    ours.draw()  # Complains about missing OpenGL in words of its own, before MuJoCo can.
    # MuJoCo loads an OpenGL library when it is imported, so this waits until ours has checked it.
    stock = stock_frames(task, config.size)
    times = alternate({"ours": ours, "stock": stock}, config.rounds)
    result = {
        "schema": 1,
        "ours_ms": round(times["ours"], 2),
        "stock_ms": round(times["stock"], 2),
        "ratio": round(times["stock"] / times["ours"], 2),
        "task": task,
        "size": config.size,
        "rounds": config.rounds,
        "ours_flags": OUR_FLAGS,
        "stock_flags": f"{stock.flags()} ({STOCK[suite]} own); colour only",
    }
    ours.close()
    stock.close()
    return result
