"""A scene of whole numbers for the guard, and the table of cases that every language must pass.

The scene is made by formulas, so that another language draws the same pictures. A case is a walk of
the hand and what its camera shows at each step. ``python -m tests.guard_scene`` writes the table
anew; what changes in it must be read.
"""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np

from madviz.guard.detector import Guard
from madviz.guard.fit import SeenEpisode, fit_values, seen_episode
from madviz.guard.pictures import sums_of
from madviz.guard.values import GuardValues
from madviz.system.files import write_json
from madviz.types import Array

CASES = Path(__file__).parent / "guard_cases.json"
SIZE = 42
STEPS = 60
Show = int | str | None


def draws(seed: int, count: int) -> list[int]:
    """Whole numbers below 2^16, by a generator that every language has."""
    numbers = []
    for _ in range(count):
        seed = (seed * 1103515245 + 12345) % 2**31
        numbers.append(seed >> 15)
    return numbers


def walk(seed: int, steps: int = STEPS) -> list[tuple[int, int]]:
    """Where the hand is, in pixels: it turns now and then, and at the borders."""
    x, y, across, down = 21, 21, 1, 0
    places = []
    for number in draws(seed, steps):
        places.append((x, y))
        if number % 4 == 0:
            across, down = [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, -1)][number // 4 % 6]
        across = across if 13 <= x + across <= 29 else -across
        down = down if 13 <= y + down <= 29 else -down
        x += across
        y += down
    return places


def picture(place: tuple[int, int]) -> Array:
    """(42, 42, 3) uint8: squares, and a bright hill over the hand."""
    y, x = np.mgrid[:SIZE, :SIZE]
    squares = 30 + 40 * ((x // 3 + y // 3) % 2)
    hill = np.maximum(0, 130 - 8 * (np.abs(x - place[0]) + np.abs(y - place[1])))
    grey = squares + hill
    return np.stack([grey, grey, grey // 2], axis=-1).astype(np.uint8)


def shown(show: Show, places: list[tuple[int, int]], step: int) -> Array | None:
    """The picture that a camera sends: ``show`` is the step it shows, or how it fails."""
    if isinstance(show, int):
        return picture(places[show])
    now = picture(places[step])
    if show == "black":
        return np.zeros_like(now)
    if show == "covered":
        now[8:30, 8:30] = 0
    if show == "noise":
        now = np.array(draws(step + 1, now.size)).astype(np.uint8).reshape(now.shape)
    if show == "blurred":  # Squares and hand are gone; brighter to the right.
        now[:] = (40 + 4 * np.arange(SIZE))[None, :, None]
    return None if show == "gone" else now


def state(place: tuple[int, int]) -> Array:
    """(2,): where the hand is, in tenths of a pixel."""
    return np.array(place, np.float64) / 10


def fitted() -> GuardValues:
    """Values of the scene's camera."""
    return fit_values([episode(seed) for seed in range(8)], (SIZE, SIZE), seeds=tuple(range(8)))


def episode(seed: int) -> SeenEpisode:
    places = walk(seed)
    pictures = [{"camera": picture(place)} for place in places]
    return seen_episode(pictures, np.array([state(place) for place in places]))


def verdicts(values: GuardValues, seed: int, shows: list[Show]) -> list[str]:
    """The kind at every step of the walk ``seed``."""
    places = walk(seed, len(shows))
    guard = Guard(values)
    return [
        guard.step({"camera": shown(show, places, step)}, state(places[step]))["camera"].kind
        for step, show in enumerate(shows)
    ]


def agreements(values: GuardValues, seed: int, steps: int) -> list[float]:
    """By lag, how well the intact pictures of a walk agree with it."""
    guard = Guard(values)
    for place in walk(seed, steps):
        guard.step({"camera": picture(place)}, state(place))
    return guard._watched["camera"]._lag.agreements()


def from_step(first: int, show: Show, last: int = STEPS) -> list[Show]:
    """A camera that shows ``show`` from step ``first`` to before ``last``, and works else."""
    return [show if first <= step < last else step for step in range(STEPS)]


def late(by: int, first: int = 0) -> list[Show]:
    return [max(step - by, 0) if step >= first else step for step in range(STEPS)]


SHOWS: dict[str, list[Show]] = {
    "intact": from_step(STEPS, None),
    "black from step 0": from_step(0, "black"),
    "black for a while": from_step(20, "black", 30),
    "gone for a while": from_step(20, "gone", 24),
    "noise": from_step(5, "noise"),
    "covered": from_step(5, "covered"),
    "blurred": from_step(5, "blurred"),
    "frozen from step 0": from_step(0, 0),
    "frozen for a while": from_step(20, 19, 35),
    "lossy": [step - (step % 4 in (1, 2)) * (step % 4) for step in range(STEPS)],
    "late from step 0": late(5),
    "late from step 20": late(5, 20),
    "late for a while": [step if step >= 40 else value for step, value in enumerate(late(4, 20))],
    "late, and one is black": ["black" if step == 30 else s for step, s in enumerate(late(5, 20))],
    "black, then frozen, then fine": [
        "black" if 10 <= step < 15 else 14 if 15 <= step < 25 else step for step in range(STEPS)
    ],
}


def table() -> dict[str, object]:
    """The whole table."""
    values = fitted()
    pictures = [picture((21, 21)), shown("noise", walk(1), 3), shown("covered", walk(1), 7)]
    return {
        "values": msgspec.to_builtins(values),
        "sums": [
            {
                "sum": int(sums.cells.sum()),
                "cells": sums.cells[:24].astype(int).tolist(),
                "spread": sums.spread,
            }
            | {"dark": sums.dark, "rough": sums.rough, "edges": sums.edges}
            for sums in map(sums_of, filter(lambda one: one is not None, pictures))
        ],
        "lags": {"walk": 100, "steps": 20, "agreements": agreements(values, 100, 20)},
        "cases": [
            {"name": name, "walk": 100, "shows": shows, "kinds": verdicts(values, 100, shows)}
            for name, shows in SHOWS.items()
        ],
    }


if __name__ == "__main__":
    write_json(CASES, table())
    for case in json.loads(CASES.read_text())["cases"]:
        kinds = case["kinds"]
        changes = [(i, k) for i, k in enumerate(kinds) if i == 0 or kinds[i - 1] != k]
        print(f"{case['name']:32}", *[f"{k}@{i}" for i, k in changes])
