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
from collections.abc import Callable
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from madviz.errors import UserError
from madviz.observation.streams import IMAGE_SIZE
from madviz.subsets import camera_of, cameras_of, mask_of
from madviz.types import CameraSpec, EnvSpec, PolicySpec

if TYPE_CHECKING:
    from madviz.agent.networks import NetworkConfig

FORMAT = 1

FIELDS: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("name", "task", "method", "setting", "recipe"), str),
    **dict.fromkeys(("definition", "render_profile", "merge"), str),
    **dict.fromkeys(("streams", "trained_subsets", "cameras"), list),
    **dict.fromkeys(("image_size", "horizon", "action_repeat"), int),
    **dict.fromkeys(("networks", "training"), dict),
    "reward_scale": (int, float),
}
"""What config.json must hold besides ``format``; other keys are kept and ignored."""

REPAIRS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}
"""Old format -> the named function that turns such a config into the next format's."""


def definition_of(env: EnvSpec) -> str:
    """What counts as success, in words; a rate without it says nothing."""
    return f"at the last step: {env.success}"


def policy_config(
    env: EnvSpec,
    networks: NetworkConfig,
    *,
    name: str,
    method: str,
    setting: str,
    recipe: str,
    streams: tuple[str, ...],
    trained_subsets: tuple[str, ...],
    training: dict[str, Any],
    merge: str = "sum",
    camera: str = "",
    reward_scale: float = 1.0,
) -> dict[str, Any]:
    """The config of a policy trained on ``env``; ``training`` is free, and goes on the card.
    ``camera`` is the one that was picked from the setting, where a method takes only one.

    Say there at least: command (how to train it again), steps, updates, seeds, wall_time_s.
    Hardware and package versions are added.
    """
    cameras = cameras_of(streams)
    config = {
        "format": FORMAT,
        **{"name": name, "task": env.task, "method": method, "setting": setting, "recipe": recipe},
        "definition": definition_of(env),
        "streams": streams,
        "trained_subsets": trained_subsets,
        "cameras": [asdict(env.camera(camera)) for camera in cameras],
        "image_size": IMAGE_SIZE,
        **{"horizon": env.horizon, "action_repeat": env.action_repeat},
        "render_profile": env.render_profile,
        **{"merge": merge, "reward_scale": reward_scale},
        **({"camera": camera} if camera else {}),
        "networks": asdict(networks),
        "training": {**training, "hardware": _hardware(), "versions": _versions()},
    }
    return json.loads(json.dumps(config))


def policy_spec(config: dict[str, Any], weights_sha256: str) -> PolicySpec:
    """What pages and evaluators read, with the digest of weights and config."""
    return PolicySpec(
        **{key: config[key] for key in ("name", "task", "method", "setting", "recipe")},
        streams=tuple(config["streams"]),
        trained_subsets=tuple(config["trained_subsets"]),
        frame_stack=config["networks"].get("frame_stack", 3),
        render_profile=config["render_profile"],
        cameras=tuple(_camera(camera) for camera in config["cameras"]),
        digest=hashlib.sha256((weights_sha256 + canonical(config)).encode()).hexdigest(),
        state_dim=config["networks"].get("state_dim", 0),
        action_dim=config["networks"].get("action_dim", 0),
        horizon=config["horizon"],
    )


def _camera(described: dict[str, Any]) -> CameraSpec:
    """A camera as JSON wrote it, lists for tuples."""
    fields: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in described.items()
    }
    try:
        return CameraSpec(**fields)
    except TypeError as error:
        raise UserError(f"expected a camera, found {described!r:.60}; restore the file") from error


def check_config(config: Any, where: Path) -> dict[str, Any]:
    """The config in today's format. Raises UserError saying what is wrong with it."""
    if not isinstance(config, dict) or not isinstance(config.get("format"), int):
        raise UserError(f"{where}: expected a policy's config with a format number; found none")
    while config["format"] in REPAIRS:
        config = REPAIRS[config["format"]](config)
    if config["format"] != FORMAT:
        raise UserError(
            f"{where}: expected format {FORMAT}, found {config['format']}; "
            "use the version of madviz that wrote it, or retrain"
        )
    for field, kind in FIELDS.items():
        if not isinstance(config.get(field), kind):
            raise UserError(
                f"{where}: expected {field!r} to be {_kind_name(kind)}, "
                f"found {config.get(field)!r:.60}; restore the file or retrain"
            )
    _check_streams(config, where)
    return config


def _kind_name(kind: type | tuple[type, ...]) -> str:
    names = {str: "a text", list: "a list", dict: "an object", int: "a whole number"}
    return names[kind] if isinstance(kind, type) else "a number"


def _check_streams(config: dict[str, Any], where: Path) -> None:
    streams = tuple(config["streams"])
    cameras = {camera.get("name") for camera in config["cameras"] if isinstance(camera, dict)}
    if not streams or not all(isinstance(s, str) and camera_of(s) in cameras for s in streams):
        raise UserError(
            f"{where}: expected streams of the cameras {sorted(map(str, cameras))}, "
            f"found {list(streams)}; restore the file or retrain"
        )
    try:
        for subset in config["trained_subsets"]:
            mask_of(str(subset), streams)
    except UserError as error:
        raise UserError(f"{where}: trained_subsets: {error}") from error


def check_environment(policy: PolicySpec, env: EnvSpec) -> None:
    """Raises UserError where ``env`` is not what ``policy`` was trained on, as far as it says."""
    cameras = {f"camera {camera.name}": camera for camera in policy.cameras}
    expected = {
        **{"task": policy.task, "render profile": policy.render_profile},
        **{"state numbers": policy.state_dim, "action numbers": policy.action_dim},
        "decisions": policy.horizon,
        **{key: _pose(camera) for key, camera in cameras.items()},
    }
    found = {
        **{"task": env.task, "render profile": env.render_profile},
        **{"state numbers": env.state_dim, "action numbers": env.action_dim},
        "decisions": env.horizon,
        **{key: _pose(env.camera(camera.name)) for key, camera in cameras.items()},
    }
    for fact, value in expected.items():
        if value and found[fact] != value:
            raise UserError(
                f"{policy.name} was trained with {fact} = {value}, this environment has "
                f"{found[fact]}; use the version of madviz that trained it, or retrain"
            )


def _pose(camera: CameraSpec) -> dict[str, Any]:
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
    found = {name: metadata.version(name) for name in packages if name in installed}
    return {"python": platform.python_version(), **found}


def canonical(config: dict[str, Any]) -> str:
    """One text for one config: keys sorted, no spaces. Raises ValueError for NaN."""
    return json.dumps(config, sort_keys=True, separators=(",", ":"), allow_nan=False)
