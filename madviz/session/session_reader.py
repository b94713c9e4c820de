"""Reads saved sessions that anybody may have written, and checks all that is in them.

The Structs below say what a file may hold, and msgspec holds a file against them: types, ranges,
names. Keys that nobody knows and keys that come twice are refused, because a misspelt command that
is passed over would make another episode. A replay checks the rest: whether task, policies and
cameras exist here, and whether the episode is as long as it says.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Literal, NoReturn

from msgspec import UNSET, Meta, Struct, UnsetType, structs

from madviz.errors import UserError
from madviz.observation.ablation import (
    CameraInput,
    CameraState,
    Occlusion,
    OcclusionKind,
    by_sides,
)
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.session.commands import SetCamera
from madviz.session.session_file import (
    MOST_STEPS,
    TRACE,
    Digest,
    EpisodeFields,
    Maker,
    PolicyName,
    SavedCommand,
    SavedEpisode,
    SavedPolicy,
    SavedSession,
)
from madviz.system.typed import typed
from madviz.types import CameraSpec

LONGEST = 4_000_000
"""Bytes in a file."""
NEXT = "save the session again, or fix the file"

Name = Annotated[str, Meta(pattern=r"\A\w{1,40}\Z")]
Short = Annotated[str, Meta(pattern=r"\A[^\x00-\x1f\x7f]{1,60}\Z")]
Share = Annotated[float, Meta(ge=0, le=1)]
Metres = Annotated[float, Meta(ge=-100, le=100)]
Range = Annotated[float, Meta(ge=0, le=1000)]
Unit = Annotated[float, Meta(ge=-1, le=1)]
Move = Annotated[float, Meta(ge=-90, le=90)]
Step = Annotated[int, Meta(ge=0, le=MOST_STEPS)]


class _Camera(Struct, forbid_unknown_fields=True):
    name: Name
    label: Short
    fovy: Annotated[float, Meta(ge=1, le=179)]
    position: tuple[Metres, Metres, Metres]
    wxyz: tuple[Unit, Unit, Unit, Unit]
    body: Short | None
    depth_range: tuple[Range, Range]
    size: Annotated[int, Meta(ge=16, le=512)]


class _Occlusion(Struct, forbid_unknown_fields=True):
    kind: OcclusionKind
    strength: Share
    x: Share
    y: Share
    width: Share | UnsetType = UNSET
    height: Share | UnsetType = UNSET
    size: Share | UnsetType = UNSET
    """The side of a square, in files from before patches had two sides."""


class _Move(Struct, forbid_unknown_fields=True):
    forward: Move
    right: Move
    up: Move
    pan: Move
    tilt: Move
    zoom: Move


class _Command(Struct, forbid_unknown_fields=True):
    """One of three: a camera is set, a camera is moved, a policy takes over."""

    step: Step | UnsetType = UNSET
    camera: Name | UnsetType = UNSET
    input: CameraInput | UnsetType = UNSET
    occlusion: _Occlusion | UnsetType = UNSET
    move: _Move | UnsetType | None = UNSET
    policy: PolicyName | UnsetType = UNSET
    digest: Digest | UnsetType = UNSET


class _Episode(EpisodeFields[_Camera, _Command, _Command], frozen=True, forbid_unknown_fields=True):
    """An episode, with its lists as a file has them."""


class _Session(Struct, forbid_unknown_fields=True):
    schema: Literal[1]
    versions: Annotated[dict[Short, Short], Meta(max_length=20)]
    episodes: Annotated[list[_Episode], Meta(min_length=1, max_length=100)]
    made_by: Maker = "madviz"


def read_session(path: str | Path) -> SavedSession:
    """The saved session in a file. Raises UserError, in one line, for anything amiss with it."""
    try:
        with Path(path).open("rb") as file:
            content = file.read(LONGEST + 1)
    except OSError as error:
        raise UserError(
            f"{path}: expected a saved session, found none ({error.strerror}); check the name"
        ) from error
    if len(content) > LONGEST:
        raise UserError(f"{path}: expected at most {LONGEST} bytes, found more; {NEXT}")
    return parse(content, str(path))


def parse(content: bytes, where: str) -> SavedSession:
    """The saved session in ``content``; ``where`` is how errors call it. Raises UserError."""
    try:
        document = json.loads(
            content.decode(), parse_constant=_refuse, object_pairs_hook=_each_once
        )
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where}: expected JSON, found a mistake: {error}; {NEXT}") from error
    session = typed(document, _Session, where, NEXT)
    try:
        episodes = [_episode(fields, f"episodes[{i}]") for i, fields in enumerate(session.episodes)]
    except UserError as error:
        raise UserError(f"{where}: {error}; {NEXT}") from error
    return SavedSession(tuple(episodes), session.versions, session.made_by)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON")


def _each_once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key that comes twice")
    return table


def _check(holds: bool, path: str, expected: str, found: object) -> None:
    if not holds:
        raise UserError(f"expected {path} to be {expected}, found {found!r:.50}")


def _episode(fields: _Episode, path: str) -> SavedEpisode:
    cameras = [_camera(camera, f"{path}.cameras[{i}]") for i, camera in enumerate(fields.cameras)]
    names = [camera.name for camera in cameras]
    _check(len(set(names)) == len(names), f"{path}.cameras", "cameras with a name each", names)
    digits = TRACE * fields.steps
    _check(len(fields.trace) == digits, f"{path}.trace", f"{digits} digits", fields.trace)
    start = [_start(command, names, f"{path}.start[{i}]") for i, command in enumerate(fields.start)]
    commands = [
        _command(command, names, fields.steps, f"{path}.commands[{i}]")
        for i, command in enumerate(fields.commands)
    ]
    steps = [command.step for command in commands]
    _check(steps == sorted(steps), f"{path}.commands", "in the order of their steps", steps)
    lists = {"cameras": tuple(cameras), "start": tuple(start), "commands": tuple(commands)}
    return SavedEpisode(**(structs.asdict(fields) | lists))


def _camera(fields: _Camera, path: str) -> CameraSpec:
    near, far = fields.depth_range
    _check(near < far, f"{path}.depth_range", "[near, far] with near < far", [near, far])
    _check(0.9 < math.hypot(*fields.wxyz) < 1.1, f"{path}.wxyz", "of norm 1", fields.wxyz)
    return CameraSpec(**structs.asdict(fields))


def _start(fields: _Command, cameras: list[str], path: str) -> SetCamera | MoveCamera:
    command = _switch(fields, cameras, path)
    _check(fields.step is UNSET, path, "a camera without a step", fields.step)
    return command


def _command(fields: _Command, cameras: list[str], steps: int, path: str) -> SavedCommand:
    step = fields.step
    if step is UNSET or not 0 <= step <= steps:
        raise UserError(f"expected {path}.step to be from 0 to {steps}, found {step!r}")
    if fields.policy is UNSET or fields.digest is UNSET:
        return SavedCommand(step, _switch(fields, cameras, path))
    _check(_keys(fields) == {"step", "policy", "digest"}, path, "a policy alone", _keys(fields))
    return SavedCommand(step, SavedPolicy(fields.policy, fields.digest))


def _switch(fields: _Command, cameras: list[str], path: str) -> SetCamera | MoveCamera:
    """How a camera is set, or where it is moved to."""
    keys = _keys(fields) - {"step"}
    if fields.camera is UNSET or fields.camera not in cameras:
        raise UserError(
            f"expected {path}.camera to be one of {', '.join(cameras)}, found {fields.camera!r}"
        )
    if fields.move is not UNSET:
        _check(keys == {"camera", "move"}, path, "a camera and its move alone", sorted(keys))
        move = fields.move and Displacement(**structs.asdict(fields.move))
        return MoveCamera(fields.camera, move)
    if fields.input is UNSET or not keys <= {"camera", "input", "occlusion"}:
        raise UserError(f"expected {path} to have camera and input, found {sorted(keys)}")
    occlusion = Occlusion() if fields.occlusion is UNSET else _occlusion(fields.occlusion, path)
    return SetCamera(fields.camera, CameraState(fields.input, occlusion))


def _occlusion(fields: _Occlusion, path: str) -> Occlusion:
    sides = _keys(fields) - {"kind", "strength", "x", "y"}
    expected = "width and height, or size"
    _check(sides in ({"width", "height"}, {"size"}), f"{path}.occlusion", expected, sorted(sides))
    values = {name: getattr(fields, name) for name in ("strength", "x", "y", *sides)}
    return Occlusion(fields.kind, **by_sides(values))


def _keys(fields: Struct) -> set[str]:
    """The keys that stand in the file."""
    return {name for name in fields.__struct_fields__ if getattr(fields, name) is not UNSET}
