"""``benchmarks guard``: what a guard costs in one step of three cameras.

A small square moves over random pictures, which differ at every step. The guard is fitted on some
of these episodes and then watches one. Beside each step, the same pictures are compared plainly:
their mean, and their mean difference from the last ones. On a busy machine the smallest times say
most, and the ratio more than the times.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from madviz.guard.detector import Guard
from madviz.guard.fit import FEWEST, fit_values, seen_episode
from madviz.system.numbers import Count
from madviz.types import Array

STREAMS = ("first", "third_a", "third_b")
STEPS = 100


@dataclass(frozen=True)
class BenchGuardConfig:
    """The pictures, and how often they are watched."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    size: Count = 84
    """Rows and columns of a picture."""
    rounds: Count = 10
    """Episodes of 100 steps."""


class GuardTimes(TypedDict):
    """Milliseconds of a step."""

    size: int
    steps: int
    median_ms: float
    lowest_tenth_ms: float
    """A tenth of the steps took less."""
    plain_lowest_tenth_ms: float
    """Likewise, of the plain comparison."""
    ratio: float
    """The guard's to the plain one's."""


def bench_guard(config: BenchGuardConfig) -> GuardTimes:
    """The times of one step with three cameras."""
    episodes = [_episode(seed, config.size) for seed in range(FEWEST + 1)]
    fitted = [seen_episode(pictures, states) for pictures, states in episodes[1:]]
    guard = Guard(fit_values(fitted, (config.size, config.size)))
    times = []
    plain = []
    for _ in range(config.rounds):
        guard.restart()
        before = episodes[0][0][0]
        for pictures, state in zip(*episodes[0], strict=True):
            begin = time.perf_counter()
            guard.step(pictures, state)
            middle = time.perf_counter()
            _plain(pictures, before)
            times.append(1e3 * (middle - begin))
            plain.append(1e3 * (time.perf_counter() - middle))
            before = pictures
    lowest = [float(np.quantile(one, 0.1)) for one in (times, plain)]
    return {
        "size": config.size,
        "steps": len(times),
        "median_ms": round(float(np.median(times)), 4),
        "lowest_tenth_ms": round(lowest[0], 4),
        "plain_lowest_tenth_ms": round(lowest[1], 4),
        "ratio": round(lowest[0] / lowest[1], 2),
    }


def _plain(pictures: dict[str, Array], before: dict[str, Array]) -> list[tuple[float, float]]:
    return [
        (picture.mean(), np.abs(picture.astype(np.int16) - before[name]).mean())
        for name, picture in pictures.items()
    ]


def _episode(seed: int, size: int) -> tuple[list[dict[str, Array]], Array]:
    """The pictures by stream, and the state (T, 2): where a bright square is."""
    rng = np.random.default_rng(seed)
    ground = rng.integers(0, 200, (size, size, 3), np.uint8)
    places = np.clip(np.cumsum(rng.uniform(-2, 2, (STEPS, 2)), 0) + size / 2, 0, size - 9)
    pictures = []
    for row, column in places.astype(int):
        picture = ground.copy()
        picture[row : row + 8, column : column + 8] = 255
        as_policies_get_it = np.ascontiguousarray(picture.transpose(2, 0, 1)).transpose(1, 2, 0)
        pictures.append(dict.fromkeys(STREAMS, as_policies_get_it))
    return pictures, places
