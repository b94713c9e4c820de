"""config.json of a policy folder: what is in it, who fills it, and when it is refused.

A config explains a policy to a reader and to a program: task, streams, cameras with their poses,
networks, render profile, and under ``training`` how it came about. Nothing a program needs is said
twice: ``networks`` alone holds the sizes of state and action and the frame stack.

    {"format": 1, "name": "metaworld-hammer-mad-light", "task": "metaworld/hammer", ...,
     "streams": ["first", "third_a", "third_b"], "trained_subsets": ["all", "first", ...],
     "networks": {"state_dim": 24, "action_dim": 4, "frame_stack": 3, "hidden_dim": 512, ...},
     "training": {"command": "madviz train ...", "updates": 9000, "seeds": ..., "wall_time_s": 540,
                  "hardware": "2 cores, ...", "versions": {"torch": ...}}}

When the format changes, its number rises and ``REPAIRS`` gets a named function that turns an old
config into the next one, so that no policy is ever retrained for the sake of a file.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shlex
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from madviz.agent.merges.merge_table import MERGES, own_options
from madviz.agent.sizes import NetworkConfig
from madviz.envs.checks import MAX_SIZE, MIN_SIZE
from madviz.errors import UserError, unknown
from madviz.observation.streams import IMAGE_SIZE
from madviz.subsets import camera_of, cameras_of, mask_of
from madviz.system.files import read_json
from madviz.system.typed import typed
from madviz.types import CameraSpec, EnvSpec, PolicySpec

FORMAT = 1
OLDER_SIZES = ("bottleneck_dim", "autoencoder", "end_to_end", "world_model")
"""Sizes that older files hold under ``networks`` for every merge, whatever their own one is."""
FIX = "restore the file or retrain"

Count = Annotated[int, Meta(ge=1, le=1_000_000)]
Document = dict[str, object]
"""A JSON object as it stands in a file."""

REPAIRS: dict[int, Callable[[Document], Document]] = {}
"""Old format -> the named function that turns such a config into the next format's."""


class TrainingRecord(msgspec.Struct, kw_only=True, frozen=True, omit_defaults=True):
    """How a policy came about, for its card and for whoever trains it again. A recipe fills in what
    it has; None is left out of the file."""

    how: str | None = None
    command: str | None = None
    """That trains it again."""
    expert_demonstrations: int | None = None
    labelled_episodes: int | None = None
    steps: int | None = None
    environment_steps: int | None = None
    episodes: int | None = None
    updates: int | None = None
    """Gradient steps."""
    critic_updates: int | None = None
    batch_size: int | None = None
    alpha: float | None = None
    """Weight of the merged feature in the loss, where the method leaves it open. Older files have a
    number in any case (``Evidence.alpha``)."""
    seeds: str | list[int] | None = None
    wall_time_s: int | float | None = None
    finished: bool | None = None
    """Whether the training reached its end."""
    device: str | None = None
    """The CUDA device on which the networks learned, if they did."""
    hardware: str | None = None
    versions: dict[str, str] | None = None


class PolicyConfig(msgspec.Struct, kw_only=True, frozen=True, omit_defaults=True):
    """config.json; its fields are in the file's order. Other keys of a file count for the digest
    and are else ignored."""

    format: int
    name: str
    task: str
    method: str
    setting: str
    recipe: str
    definition: str
    """The definition of success, in words."""
    streams: Annotated[tuple[str, ...], Meta(max_length=16)]
    """At most so many: every subset is read at every step, and there are 2^V."""
    trained_subsets: tuple[str, ...]
    cameras: tuple[CameraSpec, ...]
    """As they stood in training."""
    image_size: Annotated[int, Meta(ge=16, le=512)]
    horizon: Count
    """Decisions in an episode."""
    action_repeat: Count
    """Simulator steps for a decision."""
    render_profile: str
    merge: str
    reward_scale: float
    camera: str = ""
    """The one that was picked from the setting, where a method takes only one."""
    networks: NetworkConfig
    training: TrainingRecord

    def spec(self, digest: str) -> PolicySpec:
        """The facts that pages and evaluators read."""
        return PolicySpec(
            name=self.name,
            task=self.task,
            method=self.method,
            setting=self.setting,
            recipe=self.recipe,
            streams=self.streams,
            trained_subsets=self.trained_subsets,
            frame_stack=self.networks.frame_stack,
            render_profile=self.render_profile,
            cameras=self.cameras,
            digest=digest,
            state_dim=self.networks.state_dim,
            action_dim=self.networks.action_dim,
            horizon=self.horizon,
            reads_together=self.merge not in MERGES or not MERGES[self.merge].costly_rows,
        )

    def document(self) -> Document:
        """The content of config.json: the own sizes of a merge stand beside those of all."""
        document = msgspec.to_builtins(self)
        own = document["networks"].pop("own")
        document["networks"] |= {n: own[n] for n in _own_sizes(self.merge) if n in own}
        return document


def definition_of(env: EnvSpec) -> str:
    """The definition of success, in words; a rate without it says nothing."""
    return f"at the last step: {env.success}"


def policy_config(
    spec: PolicySpec,
    env: EnvSpec,
    networks: NetworkConfig,
    training: TrainingRecord,
    *,
    merge: str = "sum",
    camera: str = "",
    reward_scale: float = 1.0,
) -> PolicyConfig:
    """The config of the policy ``spec`` that was trained on ``env``. Of ``training`` say at least:
    command, updates, seeds, wall_time_s. Hardware and package versions are added.
    """
    return PolicyConfig(
        format=FORMAT,
        name=spec.name,
        task=env.task,
        method=spec.method,
        setting=spec.setting,
        recipe=spec.recipe,
        definition=definition_of(env),
        streams=spec.streams,
        trained_subsets=spec.trained_subsets,
        cameras=tuple(env.camera(name) for name in cameras_of(spec.streams)),
        image_size=IMAGE_SIZE,
        horizon=env.horizon,
        action_repeat=env.action_repeat,
        render_profile=env.render_profile,
        merge=merge,
        reward_scale=reward_scale,
        camera=camera,
        networks=networks,
        training=msgspec.structs.replace(training, hardware=_hardware(), versions=_versions()),
    )


def read_config(file: Path) -> tuple[PolicyConfig, str]:
    """config.json in today's format, and its canonical text, which ``digest`` takes. Raises
    UserError saying what is wrong with it."""
    document = _in_todays_format(read_json(file), file)
    return _checked(document, file), canonical(document)


def networks_of(config: PolicyConfig, text: str, where: Path) -> NetworkConfig:
    """The sizes of all networks, the own ones of a merge included, which ``read_config`` leaves
    out: their type is in the merge's file, which may load torch. ``text`` is that of
    ``read_config``. Raises UserError for sizes of another type."""
    holds_own = msgspec.defstruct("HoldsOwn", [("networks", own_options(config.merge))])
    holder: Any = typed(json.loads(text), holds_own, where, FIX)
    return replace(config.networks, own=holder.networks)


def _own_sizes(merge: str) -> tuple[str, ...]:
    return MERGES[merge].sizes if merge in MERGES else ()


def check_config(config: PolicyConfig, where: Path) -> Document:
    """The content of config.json. Raises UserError for a config that could not be read again."""
    document = config.document()
    _checked(document, where)
    return document


def digest(weights_sha256: str, text: str) -> str:
    """Names a policy: changes with its weights and with any value of its config."""
    return hashlib.sha256((weights_sha256 + text).encode()).hexdigest()


def canonical(document: Document) -> str:
    """One text for one config: keys sorted, no spaces. Raises ValueError for NaN."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _in_todays_format(document: Any, where: Path) -> Document:
    if not isinstance(document, dict) or not isinstance(document.get("format"), int):
        raise UserError(f"{where}: expected a policy's config with a format number; found none")
    while document["format"] in REPAIRS:
        document = REPAIRS[document["format"]](document)
    if document["format"] != FORMAT:
        raise UserError(
            f"{where}: expected format {FORMAT}, found {document['format']}; "
            "use the version of madviz that wrote it, or retrain"
        )
    return document


def _checked(document: Document, where: Path) -> PolicyConfig:
    config = typed(document, PolicyConfig, where, FIX)
    try:
        shlex.split(config.training.command or "")
    except ValueError as error:
        raise UserError(f"{where}: expected a command line, found {error}; {FIX}") from error
    sizes = [field.name for field in fields(NetworkConfig) if field.name != "own"]
    sizes += _own_sizes(config.merge)
    for name in typed(document["networks"], dict[str, object], where, FIX):
        if name not in (*sizes, *OLDER_SIZES):
            raise UserError(
                f"{where}: networks that cannot be built: {unknown('size', name, sizes)}"
            )
    for camera in config.cameras:
        if not MIN_SIZE <= camera.size <= MAX_SIZE:
            raise UserError(
                f"{where}: expected the size of camera {camera.name} from {MIN_SIZE} to {MAX_SIZE} "
                f"pixels, found {camera.size}; {FIX}"
            )
    cameras = {camera.name for camera in config.cameras}
    if not config.streams or not all(camera_of(s) in cameras for s in config.streams):
        raise UserError(
            f"{where}: expected streams of the cameras {sorted(cameras)}, "
            f"found {list(config.streams)}; {FIX}"
        )
    try:
        for subset in config.trained_subsets:
            mask_of(subset, config.streams)
    except UserError as error:
        raise UserError(f"{where}: trained_subsets: {error}") from error
    return config


def check_environment(policy: PolicySpec, env: EnvSpec) -> None:
    """Raises UserError where ``env`` is not what ``policy`` was trained on, as far as it says."""
    facts: list[tuple[str, object, object]] = [
        ("task", policy.task, env.task),
        ("render profile", policy.render_profile, env.render_profile),
        ("state numbers", policy.state_dim, env.state_dim),
        ("action numbers", policy.action_dim, env.action_dim),
        ("decisions", policy.horizon, env.horizon),
    ]
    for camera in policy.cameras:
        facts.append((f"camera {camera.name}", _pose(camera), _pose(env.camera(camera.name))))
    for fact, expected, found in facts:
        if expected and found != expected:
            raise UserError(
                f"{policy.name} was trained with {fact} = {expected}, this environment has "
                f"{found}; use the version of madviz that trained it, or retrain"
            )


def _pose(camera: CameraSpec) -> Document:
    """All of a camera that changes what a policy sees: not what the page calls it."""
    return {k: v for k, v in json.loads(canonical(asdict(camera))).items() if k != "label"}


def _hardware() -> str:
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    for line in cpuinfo.read_text().splitlines() if cpuinfo.exists() else ():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return f"{os.cpu_count()} cores, {model}, {platform.system()}"


def _versions() -> dict[str, str]:
    packages = ("madviz", "numpy", "torch", "mujoco", "metaworld", "opencv-python")
    installed = {d.metadata["Name"] for d in metadata.distributions()}
    versions = {name: metadata.version(name) for name in packages if name in installed}
    return {"python": platform.python_version()} | versions
