"""Serves a policy of LeRobot, so that madviz can explore and audit it.

    .venv/bin/python serve_policy.py act-hammer --task metaworld/hammer --port 8000
    madviz explore --policy ws://127.0.0.1:8000          # in madviz's own environment

A policy that was trained on LeRobot's own Meta-World acts in ``--task lerobot/hammer``; its camera
and render profile are then chosen by themselves.

The policy becomes one of madviz's (``madviz.types.Policy``), and madviz's server does the rest: its
handshake says cameras, sizes and task, so that no file is needed.

Each episode has LeRobot's own ``select_action`` between its own processors, so chunks and temporal
ensembling are those of the library. Actions go out as they are; madviz counts those that it clips.

ACT takes any list of pictures: each becomes tokens of the transformer. So a camera can be dropped
for good, with its tokens, even if the policy never lost one in training. Other policies need a
picture from each camera, and are offered black, the mean picture and noise instead.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_IMAGE, OBS_IMAGES, OBS_STATE
from normalisers import check_normalisers

from madviz.envs.registry import env_spec
from madviz.errors import UserError
from madviz.serving.serve import PolicyServer
from madviz.types import Array, Encoded, EnvSpec, PolicySpec, Readout

PREFIX = f"{OBS_IMAGES}."
CAN_DROP = ("act",)
METAWORLD = "lerobot/"
"""Tasks of LeRobot's own Meta-World begin so."""
METAWORLD_CAMERAS = {"third_a": OBS_IMAGE}


class Present(list):
    """The pictures of some cameras. ACT asks the first one how many looks there are; where no
    camera is present, ``sized`` answers."""

    def __init__(self, pictures: list[torch.Tensor], sized: torch.Tensor) -> None:
        super().__init__(pictures)
        self._sized = sized

    def __getitem__(self, at: Any) -> Any:
        return super().__getitem__(at) if len(self) else self._sized


class LeRobotPolicy:
    """A folder of LeRobot's, for looks of one step. See ``madviz.types.TakesPictures``."""

    def __init__(
        self,
        folder: Path,
        env: EnvSpec,
        action_steps: int | None = None,
        cameras: dict[str, str] | None = None,
        letterbox: bool = False,
    ) -> None:
        """``action_steps``: decisions from one look; None: as trained. ``cameras``: our camera ->
        their key, where names differ. ``letterbox``: black bars may fill a picture that is no
        square. Raises UserError for a policy that cannot act in ``env`` as it was trained."""
        config = self._config(folder, action_steps)
        keys = dict(cameras or {})
        for key in config.image_features:
            if key not in keys.values():
                keys.setdefault(key.removeprefix(PREFIX), key)
        check_features(config, env, keys, letterbox, folder)
        self.shapes = {name: config.image_features[key].shape[1:] for name, key in keys.items()}
        """Rows and columns by stream."""
        self._keys = keys
        renamed = {name: key for name, key in keys.items() if name != key.removeprefix(PREFIX)}
        self._policy = get_policy_class(config.type).from_pretrained(folder, config=config).eval()
        self._before, self._after = processors(config, folder)
        largest = max(min(shape) for shape in self.shapes.values())
        self.spec = PolicySpec(
            name=folder.resolve().name,
            task=env.task,
            method=config.type,
            setting="as trained",
            recipe="LeRobot",
            streams=tuple(keys),
            trained_subsets=("all",),
            frame_stack=1,
            render_profile=env.render_profile,
            cameras=tuple(replace(env.camera(name), size=largest) for name in keys),
            digest=digest_of(folder, action_steps, renamed, letterbox),
            state_dim=env.state_dim,
            action_dim=env.action_dim,
            horizon=env.horizon,
            image_size=largest,
            instruction=env.instruction,
            chunk=getattr(config, "n_action_steps", 1),
            can_drop=config.type in CAN_DROP,
            reads_together=False,
        )

    @staticmethod
    def _config(folder: Path, action_steps: int | None) -> Any:
        if not (folder / "config.json").is_file():
            raise UserError(
                f"{folder}: expected a folder of LeRobot's with config.json, found none; name the "
                "one that its training wrote, pretrained_model"
            )
        config: Any = PreTrainedConfig.from_pretrained(folder)
        config.device = "cpu"
        if config.n_obs_steps != 1:
            raise UserError(f"{folder}: expected a policy that looks at one step, found more")
        if hasattr(config, "pretrained_backbone_weights"):
            config.pretrained_backbone_weights = None  # The folder has them; nothing is downloaded.
        if action_steps is not None:
            most = 1 if getattr(config, "temporal_ensemble_coeff", None) else config.chunk_size
            if not 1 <= action_steps <= most:
                raise UserError(
                    f"{folder}: expected --action-steps from 1 to {most}, found {action_steps}"
                )
            config.n_action_steps = action_steps
        return config

    def encode(self, views: Array, state: Array) -> Encoded:
        """(V, 3, S, S) uint8, of cameras that all have this size."""
        seen = {name: view.transpose(1, 2, 0) for name, view in zip(self._keys, views, strict=True)}
        return self.encode_pictures(seen, state)

    def encode_pictures(self, pictures: dict[str, Array], state: Array) -> Encoded:
        """(H, W, 3) uint8 by stream, each in its own shape, to what the policy was trained on."""
        look: dict[str, Any] = {}
        for name, key in self._keys.items():
            shape = self.shapes[name]
            picture = pictures.get(name, np.zeros((*shape, 3), np.uint8))  # (H, W, 3)
            scaled = picture.transpose(2, 0, 1).astype(np.float32) / 255  # (3, H, W)
            look[key] = torch.from_numpy(scaled)
        look |= {OBS_STATE: torch.from_numpy(np.asarray(state, np.float32))}
        look |= {"task": self.spec.instruction}
        return Encoded(np.zeros((len(self._keys), 1), np.float32), look[OBS_STATE].numpy(), look)

    def action(self, memory: Any, look: dict[str, Any], mask: Array) -> Array:
        """(A,): the next decision of the episode that ``memory`` is of, as it leaves LeRobot."""
        batch = self._before(dict(look))
        if self.spec.can_drop:
            keys = [key for key, on in zip(self._keys.values(), mask, strict=True) if on]
            sized = batch[next(iter(self._keys.values()))]
            batch[OBS_IMAGES] = Present([batch[key] for key in keys], sized)
        with torch.inference_mode():
            return self._after(memory.select_action(batch))[0].numpy().astype(np.float32)

    def memory(self) -> Any:
        """The policy at the beginning of an episode: its weights are shared, its queue is new."""
        twin = copy.copy(self._policy)
        if hasattr(twin, "temporal_ensembler"):
            twin.temporal_ensembler = copy.copy(twin.temporal_ensembler)
        if self.spec.can_drop:
            model = self._policy.model
            twin.predict_action_chunk = lambda batch: model(batch)[0]  # Of the pictures present.
        twin.reset()
        return twin

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        masks = np.atleast_2d(masks)
        action = np.stack([self.reset(0).act(encoded, mask) for mask in masks])
        unknown = np.full(len(action), np.nan, np.float32)
        return Readout(np.zeros((len(action), 1), np.float32), np.clip(action, -1, 1), unknown)

    def supports(self, mask: Array) -> bool:
        return len(mask) == len(self._keys) and bool(self.spec.can_drop or np.all(mask))

    def reset(self, seed: int) -> EpisodePlayer:
        """An episode begins; ``seed`` fixes its noise, which ACT has none of."""
        return EpisodePlayer(self, seed)


class EpisodePlayer:
    """Acts in one episode, with noise of its own, whatever else acts at the same time."""

    def __init__(self, policy: LeRobotPolicy, seed: int) -> None:
        self._policy = policy
        self._memory = policy.memory()
        self._noise = torch.Generator().manual_seed(seed).get_state()

    @property
    def planned(self) -> int:
        return len(getattr(self._memory, "_action_queue", ()))

    def act(self, encoded: Encoded, mask: Array) -> Array:
        with torch.random.fork_rng(devices=[]):  # The policy is on the CPU.
            torch.set_rng_state(self._noise)
            action = self._policy.action(self._memory, encoded.private, mask)
            self._noise = torch.get_rng_state()
        return action

    def close(self) -> None:
        """There is nothing to free."""


def check_features(
    config: Any, env: EnvSpec, keys: dict[str, str], letterbox: bool, folder: Path
) -> None:
    """Raises UserError where the policy was trained on other cameras, pictures, state or actions
    than ``env`` has."""
    known = [camera.name for camera in env.cameras]
    shapes = {key: tuple(feature.shape) for key, feature in config.image_features.items()}
    if not shapes:
        raise UserError(
            f"{folder}: expected pictures of {', '.join(known)}, found none; a policy of the state "
            "alone is not served"
        )
    for name, key in keys.items():
        if key not in shapes:
            raise UserError(
                f"{folder}: expected --camera {name} to name one of {', '.join(shapes)}, found "
                f"{key!r:.100}"
            )
        if name not in known:
            raise UserError(
                f"{folder}: expected pictures of {', '.join(known)}, found {key}; say which camera "
                f"it is, as in --camera third_a={key}"
            )
        if len(shapes[key]) != 3 or shapes[key][0] != 3:
            raise UserError(
                f"{folder}: expected {key} in colour, (3, H, W), found {shapes[key]}; a policy of "
                "depth is not served"
            )
        _, height, width = shapes[key]
        if height != width and not letterbox:
            raise UserError(
                f"{folder}: expected {key} as a square, which cameras here draw, found {height} by "
                f"{width}; say --letterbox, and black bars fill the rest"
            )
    for key in shapes:
        if key not in keys.values():
            raise UserError(f"{folder}: expected --camera NAME={key}, found none; say which it is")
    numbers = {"state": (config.robot_state_feature, env.state_dim)}
    numbers |= {"action": (config.action_feature, env.action_dim)}
    for word, (feature, count) in numbers.items():
        if feature is None or tuple(feature.shape) != (count,):
            found = "none" if feature is None else tuple(feature.shape)
            raise UserError(
                f"{folder}: expected {count} {word} numbers for {env.task}, found {found}; name "
                "the task it was trained on"
            )


def processors(config: Any, folder: Path) -> tuple[Any, Any]:
    """The saved steps before and after the policy, which normalise what they should. Raises
    UserError."""
    try:
        before, after = make_pre_post_processors(
            config,
            pretrained_path=str(folder),
            preprocessor_overrides={"device_processor": {"device": "cpu"}},
        )
    except (OSError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise UserError(
            f"{folder}: expected the processors that LeRobot saves with a policy, found: "
            f"{reason:.200}; save them again, as training does"
        ) from error
    modes = config.normalization_mapping
    for steps, features, file in (
        (before.steps, config.input_features, "policy_preprocessor"),
        (after.steps, config.output_features, "policy_postprocessor"),
    ):
        check_normalisers(list(steps), features, modes, f"{folder}: {file}")
    return before, after


def digest_of(
    folder: Path, action_steps: int | None, renamed: dict[str, str], letterbox: bool
) -> str:
    """A name for this version of the policy: with its cameras ``renamed`` otherwise, it is another
    one."""
    served = [sorted(renamed.items()), letterbox] if renamed or letterbox else ""
    names = [*folder.glob("*.json"), *folder.glob("*.safetensors")]
    read = [each.read_bytes() for each in sorted(names) if each.name != "training.json"]
    return hashlib.sha256(b"".join(read) + f"{action_steps}{served}".encode()).hexdigest()


def cameras_named(words: list[str]) -> dict[str, str]:
    """``third_a=observation.image`` by camera. Raises UserError."""
    for word in words:
        if "=" not in word:
            raise UserError(f"expected --camera NAME=KEY, found {word!r:.100}")
    return dict(word.split("=", 1) for word in words)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of LeRobot's, with config.json")
    parser.add_argument("--task", default="metaworld/hammer", help="where it acts, as in madviz")
    parser.add_argument("--action-steps", type=int, help="decisions from one look")
    parser.add_argument("--camera", nargs="*", default=[], help="our camera = their key")
    parser.add_argument("--letterbox", action="store_true", help="black bars, if it is no square")
    parser.add_argument("--render-profile", choices=("fast", "full"), help="as it was trained")
    parser.add_argument("--port", type=int, default=8000)
    asked = parser.parse_args()
    try:
        theirs = asked.task.startswith(METAWORLD)
        env = env_spec(asked.task, asked.render_profile or ("full" if theirs else "fast"))
        cameras = cameras_named(asked.camera) or (METAWORLD_CAMERAS if theirs else {})
        policy = LeRobotPolicy(asked.folder, env, asked.action_steps, cameras, asked.letterbox)
        server = PolicyServer(policy, port=asked.port)
    except UserError as error:
        sys.exit(f"serve_policy.py: {error}")
    print(f"{policy.spec.name} is at {server.address}", flush=True)
    server.run()


if __name__ == "__main__":
    main()
