"""Fits the values of a guard on intact episodes: pictures and states, of any policy or expert."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from madviz.errors import UserError
from madviz.guard.detector import COVERED
from madviz.guard.lag import LAGS
from madviz.guard.pictures import CELLS, PictureSums, sums_of
from madviz.guard.values import SCHEMA, GuardValues, StreamValues, encoded_weights
from madviz.types import Array

SPANS = (1, 3, 6)
"""Steps between two pictures whose change is fitted."""
RIDGE = 0.01
"""The penalty on weights, as a share of the mean square of a change."""
READABLE = 0.5
"""The correlation, on episodes that were not fitted, from which a number counts as readable."""
NUMBERS = 4
"""The most numbers that are read from one stream."""
FEWEST = 4
"""Episodes."""
EVEN = 2.0
"""Cells of an even picture differ by less, in grey levels of 255."""


@dataclass(frozen=True, eq=False)
class SeenEpisode:
    """One intact episode of T steps."""

    sums: Mapping[str, tuple[PictureSums, ...]]
    """By stream, one for each step."""
    states: Array
    """(T, S)."""
    size: tuple[int, int]
    """Rows and columns of every picture."""


def seen_episode(pictures: Iterable[Mapping[str, Array]], states: Array) -> SeenEpisode:
    """One episode of its ``pictures`` by stream, one table for each step, and ``states`` (T, S).
    Raises UserError where a step lacks a picture or a state of finite numbers, and for pictures of
    several sizes."""
    steps: list[dict[str, PictureSums]] = []
    sizes: set[tuple[int, int]] = set()
    for step in pictures:
        steps.append({name: sums_of(picture) for name, picture in step.items()})
        sizes |= {picture.shape[:2] for picture in step.values()}
    states = np.asarray(states, np.float64)
    if states.ndim != 2 or len(states) != len(steps) or not np.isfinite(states).all():
        raise UserError(
            f"expected a state of finite numbers for each of {len(steps)} steps, found states of "
            f"shape {states.shape}; leave the episode out"
        )
    streams = list(steps[0]) if steps else []
    if not streams or any(step.keys() != set(streams) for step in steps):
        raise UserError("expected pictures of the same streams at every step, found others")
    if len(sizes) > 1:
        raise UserError(f"expected pictures of one size, found {sorted(sizes)}; resize them")
    sums = {name: tuple(step[name] for step in steps) for name in streams}
    return SeenEpisode(sums, states, sizes.pop())


def fit_values(
    episodes: list[SeenEpisode],
    size: tuple[int, int],
    state: tuple[int, ...] = (),
    seeds: tuple[int, ...] = (),
) -> GuardValues:
    """The values of a guard for pictures of ``size`` (rows, columns).

    ``state``: the places in the state that say where the robot is, by default all. Pictures of
    ``blank_steps`` are left out. Raises UserError for fewer than four episodes, also of one stream,
    for episodes of other pictures, streams or states than the rest, for a place that the state does
    not have, and for a robot that never moved.
    """
    if len(episodes) < FEWEST:
        raise UserError(f"expected {FEWEST} episodes or more to fit on, found {len(episodes)}")
    _check_alike(episodes, size)
    numbers = episodes[0].states.shape[1]
    places = tuple(map(int, state)) or tuple(range(numbers))
    if wrong := [place for place in places if not 0 <= place < numbers]:
        raise UserError(f"expected places in a state of {numbers} numbers, found {wrong[0]}")
    together = np.concatenate([episode.states[:, list(places)] for episode in episodes])
    deviation = together.std(0)
    moving = deviation > 1e-6
    if not moving.any():
        raise UserError("expected episodes in which the robot moves, found none; record others")
    places = tuple(place for place, moves in zip(places, moving, strict=True) if moves)
    unit = tuple(float(f"{value:.6g}") for value in deviation[moving])
    positions = [episode.states[:, list(places)] / np.array(unit) for episode in episodes]
    blank = blank_steps(episodes, size)
    return GuardValues(
        schema=SCHEMA,
        size=size,
        state=places,
        unit=unit,
        streams={
            name: _stream(*_shown(name, episodes, positions, set(blank[name])))
            for name in episodes[0].sums
        },
        seeds=seeds,
    )


def _check_alike(episodes: list[SeenEpisode], size: tuple[int, int]) -> None:
    """Raises UserError for an episode whose pictures have another size than ``size``, and for one
    with other streams or another state than the first."""
    first = episodes[0]
    numbers = first.states.shape[1]
    for place, one in enumerate(episodes):
        if one.size != size:
            raise UserError(
                f"expected pictures of {size}, rows and columns, found {one.size} in episode "
                f"{place}; resize them, or give their size"
            )
        if one.sums.keys() != first.sums.keys() or one.states.shape[1] != numbers:
            raise UserError(
                f"expected {', '.join(first.sums)} and {numbers} state numbers, as in episode 0, "
                f"found {', '.join(one.sums)} and {one.states.shape[1]} in episode {place}; leave "
                "it out"
            )


def blank_steps(
    episodes: list[SeenEpisode], size: tuple[int, int]
) -> dict[str, list[tuple[int, int]]]:
    """By stream, the place of an episode and the step of each picture that is even, or so dark that
    no covered lens would be darker; none for ``blind_streams``."""
    blind = blind_streams(episodes, size)
    return {
        name: [] if name in blind else _blank(name, episodes, size) for name in episodes[0].sums
    }


def blind_streams(episodes: list[SeenEpisode], size: tuple[int, int]) -> list[str]:
    """The streams of which half the pictures or more are even or dark. That is how they usually
    are, so a camera that sends black is not noticed there."""
    return [
        name
        for name in episodes[0].sums
        if 2 * len(_blank(name, episodes, size)) >= sum(len(one.sums[name]) for one in episodes)
    ]


def _blank(name: str, episodes: list[SeenEpisode], size: tuple[int, int]) -> list[tuple[int, int]]:
    even = EVEN * 3 * size[0] * size[1] / CELLS**2
    return [
        (place, step)
        for place, episode in enumerate(episodes)
        for step, picture in enumerate(episode.sums[name])
        if picture.spread < even or picture.dark + COVERED > CELLS**2
    ]


def _shown(
    name: str, episodes: list[SeenEpisode], positions: list[Array], blank: set[tuple[int, int]]
) -> tuple[list[tuple[PictureSums, ...]], list[Array]]:
    """The stretches of the episodes between ``blank`` pictures of a stream: sums and positions."""
    sums: list[tuple[PictureSums, ...]] = []
    where: list[Array] = []
    whole = 0
    for place, episode in enumerate(episodes):
        pictures = episode.sums[name]
        cuts = [step for step in range(len(pictures)) if (place, step) in blank]
        parts = [slice(a + 1, b) for a, b in pairwise([-1, *cuts, len(pictures)]) if b > a + 1]
        sums += [pictures[part] for part in parts]
        where += [positions[place][part] for part in parts]
        whole += bool(parts)
    if whole < FEWEST:
        raise UserError(
            f"expected {FEWEST} episodes or more in which {name} shows something, found {whole}: "
            "others are even or dark; fit on more episodes"
        )
    return sums, where


def _stream(sums: list[tuple[PictureSums, ...]], positions: list[Array]) -> StreamValues:
    """The values of one stream: ``sums`` and ``positions`` (T, numbers) of every episode."""
    every = [picture for episode in sums for picture in episode]
    cells = [np.array([picture.cells for picture in episode], np.float64) for episode in sums]
    numbers = _readable(cells, positions)
    scales: tuple[float, ...] = ()
    weights = ""
    if numbers:
        scales, weights = encoded_weights(_ridge(cells, positions)[:, list(numbers)])
    return StreamValues(
        spread=round(min(picture.spread for picture in every), 3),
        dark=max(picture.dark for picture in every),
        rough=max(picture.rough for picture in every),
        edges=min(picture.edges for picture in every),
        reach=tuple(np.max([*map(_reach, cells, positions)], 0).round(4).tolist()),
        numbers=numbers,
        scales=scales,
        weights=weights,
    )


def _reach(cells: Array, positions: Array) -> Array:
    """(numbers,): the largest movement, in one episode, while the picture stayed the same or
    between two pictures that are the same, up to ``LAGS`` steps apart."""
    anchor = 0
    largest = np.zeros(positions.shape[1])
    for step in range(1, len(cells)):
        if (cells[step] != cells[step - 1]).any():
            anchor = step
        past = slice(max(step - LAGS, 0), step)
        same = (cells[past] == cells[step]).all(1)  # (up to LAGS,)
        others = np.concatenate([positions[past][same], positions[anchor : anchor + 1]])
        largest = np.maximum(largest, np.abs(others - positions[step]).max(0))
    return largest


def _readable(cells: list[Array], positions: list[Array]) -> tuple[int, ...]:
    """The numbers of the state whose changes can be read on episodes that were not fitted: every
    fourth one."""
    fitted = [index for index in range(len(cells)) if index % 4]
    judged = [index for index in range(len(cells)) if not index % 4]
    matrix = _ridge([cells[i] for i in fitted], [positions[i] for i in fitted])
    change, movement = _changes([cells[i] for i in judged], [positions[i] for i in judged], (1,))
    read = change @ matrix  # (steps, numbers)
    sizes = np.sqrt((read**2).sum(0) * (movement**2).sum(0)) + 1e-9
    agreement = (read * movement).sum(0) / sizes  # (numbers,)
    best = np.argsort(-agreement, kind="stable")[:NUMBERS]
    return tuple(sorted(int(number) for number in best if agreement[number] >= READABLE))


def _ridge(cells: list[Array], positions: list[Array]) -> Array:
    """(441, numbers): from a change of the cells to a change of the position, by ridge."""
    change, movement = _changes(cells, positions, SPANS)
    size = np.sqrt((change**2).mean()) + 1e-9
    change = change / size
    products = change.T @ change  # (441, 441)
    # A stream that never changes gets weights of 0.
    penalty = RIDGE * np.trace(products) / len(products) + 1e-9
    return np.linalg.solve(products + penalty * np.eye(len(products)), change.T @ movement) / size


def _changes(
    cells: list[Array], positions: list[Array], spans: tuple[int, ...]
) -> tuple[Array, Array]:
    """Changes of the cells (n, 441), and of the position (n, numbers), over ``spans`` steps."""
    change = [c[span:] - c[:-span] for span in spans for c in cells]
    movement = [p[span:] - p[:-span] for span in spans for p in positions]
    return np.concatenate(change), np.concatenate(movement)
