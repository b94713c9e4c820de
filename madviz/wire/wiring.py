"""How a served policy's names and shapes map to madviz's: ``--wire FILE.toml``.

    task = "metaworld/hammer"
    protocol = "openpi"             # found out at the handshake where it is left out
    size = 224                      # of pictures; or one for each camera: size.first = [128, 160]
    letterbox = true                # a picture that is no square has black bars
    flip = "upside-down"            # and the other words of ``conventions.py``
    state = "observation/state"     # "" sends none
    action = "actions"
    masks = false                   # a camera that is left out must have a picture in its place
    chunk = 8                       # decisions that are taken from one look; 1 looks every time

    [cameras]                       # our name = their key
    first = "observation/wrist_image"
    third_a = "observation/image"

A key that is a list leads into tables: ``third_a = ["images", "cam_high"]``. A server of madviz's
own says all of this in its handshake, and needs no file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from madviz.envs.checks import MAX_SIZE, check_size
from madviz.envs.registry import choose, env_spec
from madviz.errors import UserError, unknown
from madviz.recorded.known import is_recording, recordings_of
from madviz.recorded.robot import robot_of
from madviz.subsets import camera_of, every_mask, mask_of, name_of
from madviz.system.files import read_toml
from madviz.system.typed import typed
from madviz.types import (
    CameraSpec,
    EnvSpec,
    Modality,
    Policy,
    PolicySpec,
    PolicyWithMemory,
    TakesPictures,
)
from madviz.wire.codec import Protocol
from madviz.wire.conventions import Conventions, check_conventions
from madviz.wire.keys import PLACES, Key, KeyPath, check_paths, outgoing

Side = Annotated[int, Meta(ge=8, le=MAX_SIZE)]
Size = Side | Annotated[list[Side], Meta(min_length=2, max_length=2)]
Digits = Annotated[int, Meta(ge=1, le=1000)]
Seconds = Annotated[float, Meta(gt=0, le=3600)]
Text = Annotated[str, Meta(max_length=500)]


class Wiring(Conventions, kw_only=True, frozen=True, forbid_unknown_fields=True):
    """The file, and what a server of madviz's own says in its handshake."""

    task: str
    cameras: Annotated[dict[str, Key], Meta(min_length=1, max_length=16)]
    """Our camera, or stream (``first.depth``) = their key."""
    size: Size | dict[str, Size]
    """Rows and columns of a picture, one number where they are the same; one size for all cameras,
    or for each."""
    state: Key
    """Their key of the state (S,) float32; '' sends none."""
    masks: bool
    """Whether the policy acts on the cameras that are sent: one that is left out is dropped."""
    action: str = "actions"
    """The key of their answer, (A,) or (n, A)."""
    protocol: Protocol | None = None
    modality: Modality | dict[str, Modality] = "rgb"
    instruction: Text | None = None
    """The task in words, sent with each observation; by default the task's own sentence."""
    chunk: Digits = 1
    """How many decisions of an answer are taken before it is asked again."""
    history: bool = False
    """Whether it remembers earlier steps of an episode, more than the rest of a chunk."""
    frames: Annotated[int, Meta(ge=1, le=8)] = 1
    """Frames of a camera in its picture, on the last axis, the oldest first."""
    letterbox: bool = False
    """Whether a picture that is no square has black bars: cameras draw squares."""
    stretch: bool = False
    """Whether the square of a camera is stretched to a picture that is no square."""
    noise: str = ""
    """Their key of a number that fixes the policy's noise at a step; '' sends none."""
    name: Annotated[str, Meta(max_length=100)] = ""
    render_profile: Literal["fast", "full"] = "fast"
    timeout: Seconds = 4.0
    """Seconds that an answer may take; the first one has a minute, for whoever compiles then."""

    @property
    def streams(self) -> tuple[str, ...]:
        """Our names in the order of axis V."""
        return tuple(self.stream(name) for name in self.cameras)

    def shape_of(self, stream: str) -> tuple[int, int]:
        """Rows and columns of what ``stream`` sends."""
        size = self.size[camera_of(stream)] if isinstance(self.size, dict) else self.size
        return (size, size) if isinstance(size, int) else (size[0], size[1])

    @property
    def largest(self) -> int:
        """Rows and columns with which all cameras are drawn: enough for the largest picture, which
        need not be a square where it was recorded."""
        side = max if is_recording(self.task) else min
        return max(side(self.shape_of(stream)) for stream in self.streams)

    def paths(self, protocol: Protocol) -> dict[str, KeyPath]:
        """By entry of the file, where its value stands in a look."""
        return outgoing(protocol, self.cameras, self.state, self.noise)

    def stream(self, name: str) -> str:
        """Our stream that ``name`` of [cameras] means."""
        if "." in name:
            return name
        modality = self.modality if isinstance(self.modality, str) else self.modality.get(name)
        return f"{name}.depth" if modality == "depth" else name


class PolicyFacts(msgspec.Struct, kw_only=True, frozen=True):
    """The further facts that a server of madviz sends, so that a policy there is the policy
    here."""

    wiring: Wiring
    name: Annotated[str, Meta(max_length=200)]
    method: Text
    setting: Text
    recipe: Text
    trained_subsets: list[Text]
    supported: list[Text]
    """The subsets it can act on."""
    digest: Text
    cameras: list[CameraSpec]


def read_wiring(path: str | Path) -> Wiring:
    """The file at ``path``. Raises UserError for one that cannot be read, lacks a key or has one
    too many, by name."""
    fix = "see docs/own-policy.md"
    document = read_toml(Path(path), "a file for --wire", fix)
    wiring = typed(document, Wiring, f"--wire {path}", fix)
    return _with_rgb(checked(wiring, path))


def _with_rgb(wiring: Wiring) -> Wiring:
    """``wiring`` with ``first.rgb`` for ``first`` beside ``first.depth``: as a subset, ``first`` is
    both."""
    deep = {camera_of(stream) for stream in wiring.streams if stream.endswith(".depth")}
    cameras = {
        f"{name}.rgb" if name in deep and wiring.stream(name) == name else name: key
        for name, key in wiring.cameras.items()
    }
    return msgspec.structs.replace(wiring, cameras=cameras)


def checked(wiring: Wiring, where: str | Path) -> Wiring:
    """``wiring``, if its task is known and has its cameras. Raises UserError."""
    known = [camera.name for camera in _cameras(wiring.task)]
    tables: list[tuple[str, Any]] = [("cameras", wiring.cameras)]
    tables += [("size", wiring.size), ("modality", wiring.modality), ("flip", wiring.flip)]
    for table, names in tables:
        for name in names if isinstance(names, dict) else ():
            if (camera_of(name) if table == "cameras" else name) not in known:
                raise UserError(f"{where}: {unknown(f'camera in [{table}]', name, known)}")
    for camera in dict.fromkeys(camera_of(stream) for stream in wiring.streams):
        if isinstance(wiring.size, dict) and camera not in wiring.size:
            raise UserError(f"{where}: expected 'size.{camera}', found none; say its pixels")
        height, width = wiring.shape_of(camera)
        fills = wiring.letterbox or wiring.stretch or height == width
        if not fills and not _as_recorded(wiring.task, camera, height, width):
            side = min(height, width)
            raise UserError(
                f"{where}: expected the size of {camera!r} to be a square, as {side} by {side}, "
                f"found {height} by {width}; say letterbox = true, and black bars fill the rest"
            )
    if wiring.letterbox and wiring.stretch:
        raise UserError(f"{where}: expected 'letterbox' or 'stretch', found both; drop one")
    for stream in wiring.streams:
        if "." in stream and is_recording(wiring.task):
            raise UserError(
                f"{where}: expected a camera's name alone, because recordings have colour only, "
                f"found {stream!r:.60}"
            )
        if "." in stream and stream.partition(".")[2] not in ("rgb", "depth"):
            raise UserError(
                f"{where}: expected a camera, or one with .rgb or .depth, found {stream!r:.60}"
            )
    if wiring.channels == "bgr" and all(s.endswith(".depth") for s in wiring.streams):
        raise UserError(
            f"{where}: expected 'channels' for a camera in colour, found depth alone; drop it"
        )
    if wiring.state == "":
        for name in ("state_order", "state_scale", "state_degrees"):
            if getattr(wiring, name) not in ([], 1.0, False):
                raise UserError(
                    f"{where}: expected {name!r} beside a state, found that none is sent; drop one"
                )
    check_conventions(wiring, env_of(wiring), where)
    _check_keys(wiring, where)
    return wiring


def _as_recorded(task: str, camera: str, height: int, width: int) -> bool:
    """True where a picture of this size has the aspect in which ``camera`` was recorded."""
    if not is_recording(task):
        return False
    own = robot_of(recordings_of(task)).camera(camera)
    return height * own.width == width * own.height


def _check_keys(wiring: Wiring, where: str | Path) -> None:
    """Raises UserError where two entries of the file send the same stream, or go out under keys
    that clash. A file that leaves the protocol out must fit each of them."""
    names: dict[str, str] = {}
    for name in wiring.cameras:
        stream = wiring.stream(name).removesuffix(".rgb")
        if stream in names:
            raise UserError(
                f"{where}: expected each stream once, found 'cameras.{names[stream]}' and "
                f"'cameras.{name}', which both send {stream!r}; drop one"
            )
        names[stream] = name
    for protocol in PLACES if wiring.protocol is None else (wiring.protocol,):
        said = "" if wiring.protocol else f" (in a look of {protocol}, as 'protocol' is left out)"
        check_paths(wiring.paths(protocol), f"{where}{said}")


def policy_spec(wiring: Wiring, address: str, identity: dict[str, str]) -> PolicySpec:
    """The specification of the policy behind ``wiring``. Another ``identity``, which its server
    says, has another digest."""
    env = env_of(wiring)
    own = {camera.name: camera for camera in _cameras(wiring.task)}
    text = msgspec.json.encode(as_written(wiring), order="sorted")
    text += msgspec.json.encode(identity, order="sorted") if identity else b""
    return PolicySpec(
        name=wiring.name or address,
        task=wiring.task,
        method="served",
        setting="as wired",
        recipe="elsewhere",
        streams=wiring.streams,
        trained_subsets=("all",),
        frame_stack=wiring.frames,
        render_profile=wiring.render_profile,
        cameras=tuple(
            replace(own[camera], size=wiring.largest)
            for camera in dict.fromkeys(camera_of(stream) for stream in wiring.streams)
        ),
        digest=hashlib.sha256(address.encode() + text).hexdigest(),
        state_dim=env.state_dim,
        action_dim=env.action_dim,
        horizon=env.horizon,
        image_size=wiring.largest,
        instruction=wiring.instruction if wiring.instruction is not None else env.instruction,
        chunk=wiring.chunk,
        can_drop=wiring.masks,
        reads_together=False,
    )


def served_spec(facts: PolicyFacts, wiring: Wiring, address: str) -> PolicySpec:
    """The same of a policy that madviz serves: it keeps its name, and its digest. Raises UserError
    for a camera that cannot be drawn."""
    for camera in facts.cameras:
        check_size(camera.size)
    return replace(
        policy_spec(wiring, address, {}),
        name=facts.name,
        method=facts.method,
        setting=facts.setting,
        recipe=facts.recipe,
        trained_subsets=tuple(facts.trained_subsets),
        cameras=tuple(facts.cameras),
        digest=facts.digest,
    )


def subsets_there(facts: PolicyFacts, wiring: Wiring) -> tuple[list[str], list[str]]:
    """The subsets that a policy of madviz's was trained on, and those that it can act on, in the
    streams of ``wiring``, whose protocol is known; without those that need a stream which
    ``wiring`` does not send."""
    assert wiring.protocol is not None
    theirs = facts.wiring.streams
    sent, wanted = (one.paths(wiring.protocol) for one in (wiring, facts.wiring))
    ours = [
        next((wiring.stream(n) for n in wiring.cameras if sent[f"cameras.{n}"] == path), None)
        for path in (wanted[f"cameras.{name}"] for name in facts.wiring.cameras)
    ]  # In the order of ``theirs``.

    def here(names: list[str]) -> list[str]:
        found = []
        for name in names:
            needed = [o for o, on in zip(ours, mask_of(name, theirs), strict=True) if on]
            if None not in needed:
                mask = np.array([stream in needed for stream in wiring.streams])
                found.append(name_of(mask, wiring.streams))
        return found

    return here(facts.trained_subsets), here(facts.supported)


def wiring_of(
    spec: PolicySpec, history: bool, shapes: Mapping[str, tuple[int, int]] | None = None
) -> Wiring:
    """How a policy of madviz's is served. ``shapes``: rows and columns by stream, where a picture
    may be no square of the policy's size; black bars fill it."""
    sizes: dict[str, Size] = {camera_of(s): [*shape] for s, shape in (shapes or {}).items()}
    return Wiring(
        task=spec.task,
        cameras={stream: stream for stream in spec.streams},
        size=sizes or spec.image_size,
        letterbox=any(height != width for height, width in (shapes or {}).values()),
        state="state",
        masks=spec.can_drop,
        history=history,
        instruction=spec.instruction,
        frames=spec.frame_stack,
        name=spec.name,
        render_profile="full" if spec.render_profile == "full" else "fast",
        chunk=spec.chunk,
    )


def served(policy: Policy) -> dict[str, Any]:
    """The facts of ``policy`` in the handshake of ``madviz serve``."""
    spec = policy.spec
    known = [name_of(m, spec.streams) for m in every_mask(len(spec.streams)) if policy.supports(m)]
    shapes = policy.shapes if isinstance(policy, TakesPictures) else None
    return {
        "wiring": as_written(wiring_of(spec, isinstance(policy, PolicyWithMemory), shapes)),
        "name": spec.name,
        "method": spec.method,
        "setting": spec.setting,
        "recipe": spec.recipe,
        "trained_subsets": list(spec.trained_subsets),
        "supported": known,
        "digest": spec.digest,
        "cameras": [asdict(camera) for camera in spec.cameras],
    }


def as_written(wiring: Wiring) -> dict[str, Any]:
    """``wiring`` as a table. A word that older versions do not know is there only where it says
    something, so that they can read it, and digests stay."""
    table = msgspec.to_builtins(wiring)
    for field in msgspec.structs.fields(Wiring):
        new = field.name in ("letterbox", "stretch", *Conventions.__struct_fields__)
        if new and getattr(wiring, field.name) in (field.default, []):
            del table[field.name]
    return table


def env_of(wiring: Wiring) -> EnvSpec:
    """The facts of the environment it acts in."""
    return env_spec(wiring.task, wiring.render_profile)


def _cameras(task: str) -> tuple[CameraSpec, ...]:
    """All cameras that ``task`` has a place for."""
    try:
        return choose(task, "five")[1]
    except UserError:
        return choose(task, "three")[1]
