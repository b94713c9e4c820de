"""A saved session: what it takes to replay an episode, in a small file.

An episode is a function of its seed and of which commands came at which step, so saving it is
writing these down: a file of some 2 KB instead of the pictures. A hammer episode in which third_a
was dropped after 20 decisions:

    {"schema": 1, "versions": {"mujoco": "3.3.0", ...}, "episodes": [{
      "policy": {"name": "metaworld-hammer-mad-light", "digest": "9f..."},
      "task": "metaworld/hammer", "render_profile": "fast", "seed": 2000, "cameras": [...],
      "start": [], "commands": [{"step": 20, "camera": "third_a", "input": "off"}],
      "steps": 100, "ended": true, "success": true, "success_any": true,
      "sha256": {"actions": "...", "rewards": "...", "success": "..."}, "trace": "0a1f..."}]}

The hashes are there to check: whoever replays it gets the same actions, rewards and success to the
bit, or learns that they differ. ``trace`` has four hexadecimal digits for every step, so it shows
where two episodes part. A session that a site kept says ``"made_by": "site"``: a browser rounds
otherwise, so its replay compares how episodes ended, not bits. Files come from anybody, so
``session_reader`` checks all that is in them; and a policy is a plain name in them, never a path or
a module that loading would import.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import asdict, dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Annotated, Generic, Literal, TypeVar

from msgspec import Meta, Struct, structs, to_builtins

from madviz.errors import UserError
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.displacement import MoveCamera
from madviz.recorded.known import SUITE
from madviz.session.commands import SetCamera
from madviz.system.files import pretty, write_bytes
from madviz.types import CameraSpec, PolicySpec

SCHEMA = 1
Maker = Literal["madviz", "site"]
"""Whose simulation it was: this one's, or that of a static site in a browser."""
PACKAGES = ("madviz", "numpy", "torch", "mujoco", "metaworld", "sapien", "opencv-python")
"""The packages on which actions depend, to the bit."""
STREAMS = ("actions", "rewards", "success")
TRACE = 4
"""Hexadecimal digits of ``trace`` for every step."""


PolicyName = Annotated[str, Meta(pattern=r"\A[^/\\:\x00-\x1f\x7f. ][^/\\:\x00-\x1f\x7f]{0,119}\Z")]
Digest = Annotated[str, Meta(pattern=r"\A[A-Za-z0-9._-]{0,128}\Z")]
_TASKS = (
    r"[a-z0-9]{1,20}/[a-z0-9-]{1,60}",
    rf"{SUITE}/[^/\\:\x00-\x1f\x7f]{{1,120}}",  # The name of a folder.
    r"[A-Za-z0-9_.]{1,120}:[A-Za-z0-9_]{1,60}",
)
Task = Annotated[str, Meta(pattern=rf"\A({'|'.join(_TASKS)})\Z")]
Sha256 = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
MOST_STEPS = 10_000
RenderProfile = Literal["fast", "full"]
CameraT = TypeVar("CameraT")
StartT = TypeVar("StartT")
CommandT = TypeVar("CommandT")


class SavedPolicy(Struct, frozen=True, forbid_unknown_fields=True):
    """A policy by name, and the digest of the weights and config that acted under it."""

    name: PolicyName
    digest: Digest

    @staticmethod
    def of(spec: PolicySpec) -> SavedPolicy:
        """Names that would be a path or a module lose what makes them one; digests, which a policy
        of one's own may choose, what a file may not have."""
        name = re.sub(r"[/\\:\x00-\x1f\x7f]", "-", spec.name).strip(" .")[:120]
        digest = re.sub(r"[^A-Za-z0-9._-]", "-", spec.digest)[:128]
        return SavedPolicy(name or "policy", digest)


@dataclass(frozen=True)
class SavedCommand:
    """A camera or a policy that was set when ``step`` had arrived, before the next decision."""

    step: int
    command: SetCamera | MoveCamera | SavedPolicy


class Hashes(Struct, frozen=True, forbid_unknown_fields=True):
    """SHA-256 of each of ``STREAMS``, step after step."""

    actions: Sha256
    """The actions are hashed as float32."""
    rewards: Sha256
    """The rewards are hashed as float64."""
    success: Sha256
    """Success is hashed as one byte."""


class EpisodeFields(
    Struct, Generic[CameraT, StartT, CommandT], frozen=True, forbid_unknown_fields=True
):
    """The fields of an episode, in a file and in memory: one table for both. A file that is read is
    held against these types, and against those that ``session_reader`` has for the lists."""

    policy: SavedPolicy
    """The policy that acted first."""
    task: Task
    render_profile: RenderProfile
    cameras: Annotated[tuple[CameraT, ...], Meta(min_length=1, max_length=16)]
    """All that the environment drew, the policy's and others."""
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    start: Annotated[tuple[StartT, ...], Meta(max_length=16)]
    """The states of cameras when the episode began; those that are not named were intact."""
    commands: Annotated[tuple[CommandT, ...], Meta(max_length=10_000)]
    """In the order in which they were obeyed."""
    steps: Annotated[int, Meta(ge=1, le=MOST_STEPS)]
    ended: bool
    """Whether ``steps`` is the horizon; otherwise somebody left earlier."""
    success: bool
    """At the last saved step."""
    success_any: bool
    sha256: Hashes
    trace: Annotated[str, Meta(pattern=r"\A[0-9a-f]*\Z")]


class SavedEpisode(EpisodeFields[CameraSpec, SetCamera | MoveCamera, SavedCommand], frozen=True):
    """One episode, from its first step to the last one that was taken."""

    @property
    def ablation(self) -> Ablation:
        """The states of the cameras at the start."""
        ablation = Ablation()
        for command in self.start:
            if isinstance(command, MoveCamera):
                ablation = ablation.move(command.camera, command.move)
            else:
                ablation = ablation.replace(command.camera, command.state)
        return ablation

    @property
    def policies(self) -> tuple[SavedPolicy, ...]:
        """All that acted, each once, in order."""
        swapped = [one.command for one in self.commands if isinstance(one.command, SavedPolicy)]
        return tuple(dict.fromkeys([self.policy, *swapped]))


@dataclass(frozen=True)
class SavedSession:
    """Episodes in the order in which they were played."""

    episodes: tuple[SavedEpisode, ...]
    versions: dict[str, str]
    """The versions of the packages that it was made with; with others, the last bits may differ."""
    made_by: Maker = "madviz"

    def to_json(self) -> str:
        """As a file has it; ``session_reader.parse`` is the way back."""
        return pretty(
            {
                "schema": SCHEMA,
                **({"made_by": self.made_by} if self.made_by != "madviz" else {}),
                "versions": self.versions,
                "episodes": [_episode_fields(episode) for episode in self.episodes],
            }
        )

    def write(self, path: Path) -> None:
        write_bytes(path, self.to_json().encode())

    def episode(self, number: int | None) -> SavedEpisode:
        """Episode ``number``, from 1; None: the last. Raises UserError where there is none."""
        count = len(self.episodes)
        if number is not None and not 1 <= number <= count:
            raise UserError(f"expected an episode from 1 to {count}, found {number}; leave it out")
        return self.episodes[-1 if number is None else number - 1]


@cache
def versions_here() -> dict[str, str]:
    """The versions of PACKAGES that are installed."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def hashes(streams: dict[str, list[bytes]]) -> Hashes:
    """SHA-256 of each of STREAMS."""
    digests = {name: hashlib.sha256(b"".join(streams[name])).hexdigest() for name in STREAMS}
    return Hashes(**digests)


def trace_of(streams: dict[str, list[bytes]]) -> str:
    """TRACE digits for every step, of its action, reward and success together."""
    steps = zip(*(streams[name] for name in STREAMS), strict=True)
    return "".join(hashlib.sha256(b"".join(step)).hexdigest()[:TRACE] for step in steps)


def _episode_fields(episode: SavedEpisode) -> dict[str, object]:
    commands = {
        "start": [_camera_fields(command) for command in episode.start],
        "commands": [_command_fields(command) for command in episode.commands],
    }
    return to_builtins({**structs.asdict(episode), **commands})


def _command_fields(saved: SavedCommand) -> dict[str, object]:
    if isinstance(saved.command, SavedPolicy):
        return {"step": saved.step, "policy": saved.command.name, "digest": saved.command.digest}
    return {"step": saved.step, **_camera_fields(saved.command)}


def _camera_fields(command: SetCamera | MoveCamera) -> dict[str, object]:
    """The occlusion is left out where it is none; one that is off may still have a strength, as a
    slider left it, and that is saved: equal means equal."""
    if isinstance(command, MoveCamera):
        return {"camera": command.camera, "move": asdict(command.move) if command.move else None}
    state: CameraState = command.state
    fields: dict[str, object] = {"camera": command.camera, "input": state.input}
    if state.occlusion != Occlusion():
        fields["occlusion"] = asdict(state.occlusion)
    return fields
