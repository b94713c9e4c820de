"""Reads saved sessions that anybody may have written, and checks all that is in them.

Every value is checked for its type and range before anything is made of it; keys that nobody knows
are refused, because a misspelt command that is passed over would make another episode. What is left
to whoever replays the episode: whether task, policies and cameras exist here, and whether the
episode is as long as it says.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn

from madviz.errors import UserError
from madviz.observation.ablation import CameraState, Occlusion, by_sides
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.session.commands import SetCamera
from madviz.session.session_file import (
    SCHEMA,
    STREAMS,
    TRACE,
    SavedCommand,
    SavedEpisode,
    SavedPolicy,
    SavedSession,
)
from madviz.types import CameraSpec

LONGEST = 4_000_000
"""Bytes in a file."""
MOST_EPISODES, MOST_CAMERAS, MOST_COMMANDS, MOST_STEPS = 100, 16, 10_000, 10_000
NEXT = "save the session again, or mend the file"

_CAMERA = r"[a-z][a-z0-9_]{0,23}"
_POLICY = r"[^/\\:\x00-\x1f\x7f. ][^/\\:\x00-\x1f\x7f]{0,119}"
_DIGEST = r"[A-Za-z0-9._-]{0,128}"
_TASK = r"[a-z0-9]{1,20}/[a-z0-9-]{1,60}|[A-Za-z0-9_.]{1,120}:[A-Za-z0-9_]{1,60}"
_SHORT = r"[^\x00-\x1f\x7f]{1,60}"


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
    """The saved session in ``content``; ``where`` is how errors call it."""
    try:
        document = json.loads(
            content.decode(), parse_constant=_refuse, object_pairs_hook=_each_once
        )
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where}: expected JSON, found a mistake: {error}; {NEXT}") from error
    return _Value(document, where, "the file").session()


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON")


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key that comes twice")
    return found


class _Value:
    """Something in a file, and the path to it. Every method raises UserError if it is not that."""

    def __init__(self, found: Any, file: str, path: str) -> None:
        self.found, self.file, self.path = found, file, path

    def fail(self, expected: str) -> UserError:
        found = f"{self.found!r:.50}".replace("\n", " ")
        return UserError(
            f"{self.file}: expected {self.path} to be {expected}, found {found}; {NEXT}"
        )

    def fields(self, *required: str, optional: tuple[str, ...] = ()) -> dict[str, _Value]:
        """The values of an object that has these keys and no others."""
        known = (*required, *optional)
        found = self.found
        if not isinstance(found, dict) or not set(required) <= found.keys() <= set(known):
            raise self.fail(f"an object with {', '.join(known)}")
        prefix = "" if self.path == "the file" else f"{self.path}."
        return {key: _Value(found[key], self.file, f"{prefix}{key}") for key in found}

    def items(self, most: int, least: int = 0) -> list[_Value]:
        found = self.found
        if not isinstance(found, list) or not least <= len(found) <= most:
            raise self.fail(f"a list of {least} to {most}")
        return [_Value(one, self.file, f"{self.path}[{i}]") for i, one in enumerate(found)]

    def text(self, pattern: str, what: str) -> str:
        if not isinstance(self.found, str) or not re.fullmatch(pattern, self.found):
            raise self.fail(what)
        return self.found

    def whole(self, low: int, high: int) -> int:
        if type(self.found) is not int or not low <= self.found <= high:
            raise self.fail(f"a whole number from {low} to {high}")
        return self.found

    def number(self, low: float, high: float) -> float:
        found = self.found
        if type(found) not in (int, float) or not (math.isfinite(found) and low <= found <= high):
            raise self.fail(f"a number from {low:g} to {high:g}")
        return found

    def numbers(self, count: int, low: float, high: float) -> tuple[float, ...]:
        return tuple(one.number(low, high) for one in self.items(count, count))

    def truth(self) -> bool:
        if type(self.found) is not bool:
            raise self.fail("true or false")
        return self.found

    # What a saved session is made of.

    def session(self) -> SavedSession:
        if not isinstance(self.found, dict) or self.found.get("schema") != SCHEMA:
            raise self.fail(f"a saved session of schema {SCHEMA}")
        fields = self.fields("schema", "versions", "episodes")
        fields["schema"].whole(SCHEMA, SCHEMA)
        versions = fields["versions"]
        if not isinstance(versions.found, dict) or len(versions.found) > 20:
            raise versions.fail("an object with at most 20 versions")
        for name in versions.found:
            _Value(name, self.file, "a package's name").text(_SHORT, "a short text")
        return SavedSession(
            tuple(one.episode() for one in fields["episodes"].items(MOST_EPISODES, 1)),
            {
                name: _Value(version, self.file, f"versions.{name}").text(_SHORT, "a short text")
                for name, version in versions.found.items()
            },
        )

    def episode(self) -> SavedEpisode:
        fields = self.fields(*SavedEpisode.__dataclass_fields__)
        steps = fields["steps"].whole(1, MOST_STEPS)
        cameras = tuple(one.camera() for one in fields["cameras"].items(MOST_CAMERAS, 1))
        names = [camera.name for camera in cameras]
        if len(set(names)) < len(names):
            raise fields["cameras"].fail("cameras with a name each")
        commands = [one.command(names, steps) for one in fields["commands"].items(MOST_COMMANDS)]
        if any(a.step > b.step for a, b in zip(commands, commands[1:], strict=False)):
            raise fields["commands"].fail("in the order of their steps")
        policy = fields["policy"].fields("name", "digest")
        sha256 = fields["sha256"].fields(*STREAMS)
        return SavedEpisode(
            policy=_policy(policy["name"], policy["digest"]),
            task=fields["task"].text(_TASK, "a task such as metaworld/hammer"),
            render_profile=fields["render_profile"].text("fast|full", "fast or full"),
            cameras=cameras,
            seed=fields["seed"].whole(0, 2**31 - 1),
            start=tuple(one.switch(names) for one in fields["start"].items(MOST_CAMERAS)),
            commands=tuple(commands),
            steps=steps,
            ended=fields["ended"].truth(),
            success=fields["success"].truth(),
            success_any=fields["success_any"].truth(),
            sha256={
                name: value.text("[0-9a-f]{64}", "64 hexadecimal digits")
                for name, value in sha256.items()
            },
            trace=fields["trace"].text(
                f"[0-9a-f]{{{TRACE * steps}}}", f"{TRACE * steps} hexadecimal digits"
            ),
        )

    def command(self, cameras: list[str], steps: int) -> SavedCommand:
        if isinstance(self.found, dict) and "policy" in self.found:
            fields = self.fields("step", "policy", "digest")
            command = _policy(fields["policy"], fields["digest"])
        else:
            command = self.switch(cameras, ("step",))
            fields = {"step": _Value(self.found["step"], self.file, f"{self.path}.step")}
        return SavedCommand(fields["step"].whole(0, steps), command)

    def switch(self, cameras: list[str], beside: tuple[str, ...] = ()) -> SetCamera | MoveCamera:
        """How a camera is set, or where it is moved to."""
        if isinstance(self.found, dict) and "move" in self.found:
            fields = self.fields(*beside, "camera", "move")
        else:
            fields = self.fields(*beside, "camera", "input", optional=("occlusion",))
        name = fields["camera"].text(_CAMERA, f"one of {', '.join(cameras)}")
        if name not in cameras:
            raise fields["camera"].fail(f"one of {', '.join(cameras)}")
        if "move" in fields:
            return MoveCamera(name, fields["move"].move())
        input_ = fields["input"].text("rgb|depth|both|off", "rgb, depth, both or off")
        occlusion = fields["occlusion"].occlusion() if "occlusion" in fields else Occlusion()
        return SetCamera(name, CameraState(input_, occlusion))  # type: ignore[arg-type]

    def occlusion(self) -> Occlusion:
        # Files from before patches had two sides say how large a square is.
        square = isinstance(self.found, dict) and "size" in self.found
        sides = ("size",) if square else ("width", "height")
        fields = self.fields("kind", "strength", "x", "y", *sides)
        kind = fields.pop("kind").text("[a-z]{1,20}", "a kind of occlusion")
        fractions = {name: value.number(0, 1) for name, value in fields.items()}
        try:
            return Occlusion(kind, **by_sides(fractions))  # type: ignore[arg-type]
        except UserError as error:
            raise UserError(f"{self.file}: {self.path}: {error}") from error

    def move(self) -> Displacement | None:
        if self.found is None:
            return None
        fields = self.fields(*Displacement.__dataclass_fields__)
        numbers = {name: value.number(-90, 90) for name, value in fields.items()}
        try:
            return Displacement(**numbers)
        except UserError as error:
            raise UserError(f"{self.file}: {self.path}: {error}") from error

    def camera(self) -> CameraSpec:
        fields = self.fields(*CameraSpec.__dataclass_fields__)
        position, wxyz = fields["position"].numbers(3, -100, 100), fields["wxyz"].numbers(4, -1, 1)
        near, far = fields["depth_range"].numbers(2, 0, 1000)
        if near >= far:
            raise fields["depth_range"].fail("[near, far] with near < far")
        if not 0.9 < math.hypot(*wxyz) < 1.1:
            raise fields["wxyz"].fail("of norm 1")
        body = fields["body"]
        return CameraSpec(
            name=fields["name"].text(_CAMERA, "a name of small letters, digits and _"),
            label=fields["label"].text(_SHORT, "a short text"),
            fovy=fields["fovy"].number(1, 179),
            position=(position[0], position[1], position[2]),
            wxyz=(wxyz[0], wxyz[1], wxyz[2], wxyz[3]),
            body=None if body.found is None else body.text(_SHORT, "null or a short text"),
            depth_range=(near, far),
            size=fields["size"].whole(16, 512),
        )


def _policy(name: _Value, digest: _Value) -> SavedPolicy:
    return SavedPolicy(
        name.text(_POLICY, "a policy's plain name"),
        digest.text(_DIGEST, "a digest of letters and digits"),
    )
