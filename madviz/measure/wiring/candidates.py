"""The changes of a wire file that are tried, each by itself.

Of each kind the one that acts most like the expert goes on to episodes (``screen.py``), so a kind
may have many: three flips of all pictures and of each camera's, 23 orders of a state that repeats
four numbers.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, pairwise, permutations
from typing import Any

import msgspec

from madviz.errors import UserError
from madviz.subsets import camera_of
from madviz.types import EnvSpec
from madviz.wire.conventions import AXES, Flip
from madviz.wire.wiring import Wiring, checked

FLIPS: dict[Flip, str] = {
    "none": "not turned",
    "upside-down": "upside down",
    "mirrored": "mirrored",
    "turned": "turned by half a turn",
}
SIZES = (84, 224)
"""Rows and columns that policies often take, beside half and twice the present ones."""
UNITS = (1000.0, 100.0, 0.01, 0.001)
FACTORS = tuple(
    step * 10.0**power for power in range(-3, 3) for step in (1, 2, 5) if power or step > 1
)
MOST_SWAPS = 28
"""Pairs of columns that are swapped; in a longer state, neighbours alone."""


@dataclass(frozen=True)
class Candidate:
    """A changed file."""

    kind: str
    label: str
    """The change, after the word ``with``."""
    lines: str
    """The line to write into the file."""
    wiring: Wiring


def candidates(wiring: Wiring, env: EnvSpec) -> list[Candidate]:
    """Every change of ``wiring`` that makes sense for the task of ``env``; see the module."""
    found = []
    parts = (_pictures, _shapes, _state_order, _state_units, _action_signs, _action_scale)
    for part in parts:
        for kind, label, words in part(wiring, env):
            try:
                changed = checked(msgspec.structs.replace(wiring, **words), "")
            except UserError:  # A change that makes no sense here.
                continue
            lines = "\n".join(f"{name} = {_toml(value)}" for name, value in words.items())
            found.append(Candidate(kind, label, lines, changed))
    return found


Change = tuple[str, str, dict[str, Any]]
"""Kind, label, and the words of the file with their new values."""


def _pictures(wiring: Wiring, env: EnvSpec) -> Iterator[Change]:
    cameras = list(dict.fromkeys(camera_of(stream) for stream in wiring.streams))
    now = {camera: wiring.flip_of(camera) for camera in cameras}
    for flip in AXES:
        if set(now.values()) != {flip}:
            yield "flip", f"pictures {FLIPS[flip]}", {"flip": flip}
        for camera in cameras if len(cameras) > 1 else ():
            if now[camera] != flip:
                label = f"pictures of {camera} {FLIPS[flip]}"
                yield "flip", label, {"flip": {**now, camera: flip}}
    channels = "bgr" if wiring.channels == "rgb" else "rgb"
    yield "channels", f"colours as {channels}", {"channels": channels}
    values = "0-1" if wiring.values == "0-255" else "0-255"
    yield "values", f"pictures from {values.replace('-', ' to ')}", {"values": values}
    for one, other in combinations(wiring.cameras, 2):
        keys = wiring.cameras
        swapped = {**keys, one: keys[other], other: keys[one]}
        yield "cameras", f"{one} and {other} swapped", {"cameras": swapped}


def _shapes(wiring: Wiring, env: EnvSpec) -> Iterator[Change]:
    shapes = {wiring.shape_of(stream) for stream in wiring.streams}
    if len(shapes) > 1:
        return
    ((height, width),) = shapes
    if height != width:
        for side in sorted({height, width}, reverse=True):
            label = f"square pictures of {side} pixels"
            yield "shape", label, {"size": side, "letterbox": False, "stretch": False}
        word = "stretch" if wiring.letterbox else "letterbox"
        label = "pictures stretched" if wiring.letterbox else "black bars beside the pictures"
        yield "shape", label, {"letterbox": word == "letterbox", "stretch": word == "stretch"}
        return
    for side in sorted({height // 2, 2 * height, *SIZES} - {height}):
        yield "size", f"pictures of {side} pixels", {"size": side}
    wide = [height * 3 // 4, height]
    label = f"pictures of {wide[0]} by {wide[1]} pixels with black bars"
    yield "shape", label, {"size": wide, "letterbox": True, "stretch": False}


def _state_order(wiring: Wiring, env: EnvSpec) -> Iterator[Change]:
    """A state often repeats a block of numbers, one for each of the last decisions; an order of a
    block's numbers is tried in all blocks alike."""
    if wiring.state == "":
        return
    now = wiring.state_order or list(range(env.state_dim))
    count = len(now)
    seen = {tuple(now)}
    for block in (size for size in range(1, count + 1) if count % size == 0):
        starts = range(0, count, block)
        orders = [[start + i for start in starts for i in order] for order in _orders(block)]
        if block < count:
            orders += [[start + i for start in reversed(starts) for i in range(block)]]
            orders += [list(range(count - block, count)), list(range(block))]
        for order in orders:
            new = [now[index] for index in order]
            if tuple(new) not in seen:
                seen.add(tuple(new))
                yield "state order", f"the state's numbers in the order {new}", {"state_order": new}


def _orders(count: int) -> Iterator[list[int]]:
    """Orders of ``count`` numbers: all up to four; else two swapped, and one end at the other."""
    whole = list(range(count))
    if count <= 4:
        yield from map(list, permutations(whole))
        return
    pairs = list(combinations(whole, 2))
    for one, other in pairs if len(pairs) <= MOST_SWAPS else pairwise(whole):
        swapped = list(whole)
        swapped[one] = other
        swapped[other] = one
        yield swapped
    yield from ([*whole[1:], 0], [whole[-1], *whole[:-1]])


def _state_units(wiring: Wiring, env: EnvSpec) -> Iterator[Change]:
    if env.state_numbers.angles:
        unit = "radians" if wiring.state_degrees else "degrees"
        yield "state units", f"angles in {unit}", {"state_degrees": not wiring.state_degrees}
    if isinstance(wiring.state_scale, float):
        for factor in UNITS:
            words = {"state_scale": wiring.state_scale * factor}
            yield "state units", f"the state times {factor:g}", words


def _action_signs(wiring: Wiring, env: EnvSpec) -> Iterator[Change]:
    count = env.action_dim
    signs = wiring.action_sign or [1] * count
    for index in range(count - bool(env.gripper)):
        new = [-sign if i == index else sign for i, sign in enumerate(signs)]
        yield "action sign", f"the sign of action number {index} changed", {"action_sign": new}
    if env.gripper:
        words = {"gripper_inverted": not wiring.gripper_inverted}
        yield "gripper", "the gripper inverted", words
    order = wiring.action_order or list(range(count))
    for new in _orders(count):
        if new != list(range(count)):
            ordered = [order[index] for index in new]
            label = f"the action's numbers in the order {ordered}"
            yield "action order", label, {"action_order": ordered}


def _action_scale(wiring: Wiring, env: EnvSpec) -> Iterator[Change]:
    if isinstance(wiring.action_scale, float):
        for factor in FACTORS:
            words = {"action_scale": wiring.action_scale * factor}
            yield "action scale", f"actions times {factor:g}", words


def _toml(value: Any) -> str:
    """``value`` as a wire file has it."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + " }"
    return json.dumps(value)
