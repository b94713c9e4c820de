"""How the numbers of a look and of an answer are meant: the words of ``--wire`` for it.

                what madviz has                     words
    pictures    upright, rgb, 0 to 255              flip, channels, values
    state       (S,), in units of the task          state_order, state_scale, state_degrees
    actions     (A,), -1 to 1, steps of the hand    action_order, action_sign, action_scale,
                                                    gripper_inverted, absolute

Without a word, numbers go out and come back as they are. ``action_order`` comes before the other
words for actions, so these count the numbers of madviz's action.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from madviz.errors import UserError
from madviz.types import Array, EnvSpec

Flip = Literal["none", "upside-down", "mirrored", "turned"]
AXES: Mapping[Flip, tuple[int, ...]] = {
    "none": (),
    "upside-down": (0,),
    "mirrored": (1,),
    "turned": (0, 1),
}
"""By flip, the axes of a picture that run the other way; ``turned`` is half a turn."""
Index = Annotated[int, Meta(ge=0, le=1000)]
Factor = Annotated[float, Meta(gt=0, le=1e6)]
Sign = Literal[-1, 1]


class Absolute(msgspec.Struct, kw_only=True, frozen=True, forbid_unknown_fields=True):
    """An action that names a place, where the task wants the way to it."""

    state: Annotated[list[Index], Meta(min_length=1)]
    """The state numbers that hold the present place; as many numbers of the action, from the first
    one on, are places."""
    step: Factor
    """The way that an action of 1 goes, in the state's unit."""


class Conventions(msgspec.Struct, kw_only=True, frozen=True):
    """See the module."""

    flip: Flip | dict[str, Flip] = "none"
    """How pictures are turned before they are sent, all of them or those of each camera."""
    channels: Literal["rgb", "bgr"] = "rgb"
    values: Literal["0-255", "0-1"] = "0-255"
    """Range of a picture's numbers: whole ones, or float32."""
    state_order: list[Index] = []
    """For each number that is sent, which of the task's; empty: all, as they are."""
    state_scale: Factor | list[Factor] = 1.0
    """The factor of each number that is sent."""
    state_degrees: bool = False
    """Whether the task's angles are sent in degrees; they are in radians."""
    action_order: list[Index] = []
    """For each number of the task's action, which of the answer's."""
    action_sign: list[Sign] = []
    action_scale: Factor | list[Factor] = 1.0
    """The factor of each number of an action."""
    gripper_inverted: bool = False
    """Whether the policy opens the gripper with numbers that close it here."""
    absolute: Absolute | None = None

    def flip_of(self, camera: str) -> Flip:
        """How the pictures of ``camera`` are turned."""
        return self.flip.get(camera, "none") if isinstance(self.flip, dict) else self.flip

    def sent_picture(self, picture: Array, camera: str, colour: bool) -> Array:
        """(H, W, 3 x frames) uint8 as it is sent, uint8 or float32. ``colour``: no depth."""
        if axes := AXES[self.flip_of(camera)]:
            picture = np.flip(picture, axes)
        if self.channels == "bgr" and colour:
            frames = picture.reshape(*picture.shape[:2], -1, 3)  # (H, W, frames, 3)
            picture = frames[..., ::-1].reshape(picture.shape)
        picture = np.ascontiguousarray(picture)
        return picture if self.values == "0-255" else picture.astype(np.float32) / 255

    def sent_state(self, state: Array, env: EnvSpec) -> Array:
        """(S,) as it is sent, (S',) float32."""
        if self.state_degrees:
            state = state.copy()
            angles = list(env.state_numbers.angles)
            state[angles] = np.degrees(state[angles])
        if self.state_order:
            state = state[self.state_order]
        return np.asarray(state * np.asarray(self.state_scale), np.float32)

    def own_action(self, answer: Array, state: Array, env: EnvSpec) -> Array:
        """A row (A,) of an answer as the task's action, (A,) float32, before it is clipped;
        ``state`` (S,) is the one it acts in."""
        action = answer[self.action_order] if self.action_order else answer.copy()
        if self.action_sign:
            action = action * np.asarray(self.action_sign)
        action = np.asarray(action * np.asarray(self.action_scale), np.float32)
        if self.gripper_inverted:
            action[-1] = -action[-1]
        if self.absolute is not None:
            places = len(self.absolute.state)
            action[:places] = (action[:places] - state[self.absolute.state]) / self.absolute.step
        return action


def check_conventions(words: Conventions, env: EnvSpec, where: str | Path) -> None:
    """Raises UserError where a word of ``words`` makes no sense for the task of ``env``."""
    _check_state(words, env, where)
    _check_action(words, env, where)
    if words.absolute is not None:
        indices = words.absolute.state
        _check_indices("absolute.state", indices, env.state_dim, where)
        if len(indices) > env.action_dim:
            raise UserError(
                f"{where}: expected 'absolute.state' to be {env.action_dim} numbers at most, as "
                f"many as an action of {env.task} has, found {len(indices)}"
            )


def _check_state(words: Conventions, env: EnvSpec, where: str | Path) -> None:
    _check_indices("state_order", words.state_order, env.state_dim, where)
    sent = len(words.state_order) or env.state_dim
    _check_length("state_scale", words.state_scale, sent, where)
    if words.state_degrees and not env.state_numbers.angles:
        raise UserError(
            f"{where}: expected 'state_degrees' for a task whose state has angles, found "
            f"{env.task}, whose state has none; drop it"
        )


def _check_action(words: Conventions, env: EnvSpec, where: str | Path) -> None:
    count = env.action_dim
    _check_indices("action_order", words.action_order, count, where)
    for name in ("action_order", "action_sign", "action_scale"):
        _check_length(name, getattr(words, name), count, where)
    if words.gripper_inverted and not env.gripper:
        raise UserError(
            f"{where}: expected 'gripper_inverted' for a task with a gripper, found {env.task}; "
            "drop it"
        )
    if words.gripper_inverted and words.action_sign and words.action_sign[-1] == -1:
        raise UserError(
            f"{where}: expected the gripper to be inverted once, found 'gripper_inverted' and -1 "
            "at the end of 'action_sign'; drop one"
        )


def _check_indices(name: str, indices: list[int], count: int, where: str | Path) -> None:
    if len(set(indices)) < len(indices) or any(index >= count for index in indices):
        raise UserError(
            f"{where}: expected {name!r} to be numbers from 0 to {count - 1}, each once, found "
            f"{indices!s:.100}"
        )


def _check_length(name: str, numbers: object, count: int, where: str | Path) -> None:
    if isinstance(numbers, list) and numbers and len(numbers) != count:
        raise UserError(f"{where}: expected {name!r} to be {count} numbers, found {len(numbers)}")
