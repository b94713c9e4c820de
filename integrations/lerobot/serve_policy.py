"""Serves a policy of LeRobot, so that madviz can explore and audit it.

    .venv/bin/python serve_policy.py act-hammer --task metaworld/hammer --port 8000
    madviz explore --policy ws://127.0.0.1:8000          # in madviz's own environment

The policy becomes one of madviz's (``madviz.types.Policy``), and madviz's server does the rest: its
handshake says cameras, sizes and task, so that no file is needed.

ACT takes any list of pictures: each becomes tokens of the transformer. So a camera can be dropped
for good, with its tokens, even if the policy never lost one in training. Other policies need a
picture from each camera, and are offered black, the mean picture and noise instead.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE

from madviz.envs.registry import env_spec
from madviz.errors import UserError
from madviz.serving.serve import PolicyServer
from madviz.types import Array, Encoded, PolicySpec, Readout

PREFIX = f"{OBS_IMAGES}."
CAN_DROP = ("act",)


class Present(list):
    """The pictures of some cameras. ACT asks the first one how many looks there are; where no
    camera is present, ``sized`` answers."""

    def __init__(self, pictures: list[torch.Tensor], sized: torch.Tensor) -> None:
        super().__init__(pictures)
        self._sized = sized

    def __getitem__(self, at: Any) -> Any:
        return super().__getitem__(at) if len(self) else self._sized


class LeRobotPolicy:
    """A folder of LeRobot's, for looks of one step."""

    def __init__(self, folder: Path, task: str, action_steps: int | None) -> None:
        """``action_steps``: decisions from one look; None: as trained. Raises UserError."""
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = "cpu"
        if config.n_obs_steps != 1:
            raise UserError(f"{folder}: expected a policy that looks at one step, found more")
        if hasattr(config, "pretrained_backbone_weights"):
            config.pretrained_backbone_weights = None  # The folder has them; nothing is downloaded.
        self._policy = get_policy_class(config.type).from_pretrained(folder, config=config).eval()
        self._before, self._after = make_pre_post_processors(config, pretrained_path=str(folder))
        self._keys = list(config.image_features)
        env = env_spec(task)
        self.spec = PolicySpec(
            name=folder.resolve().name,
            task=task,
            method=config.type,
            setting="as trained",
            recipe="LeRobot",
            streams=tuple(key.removeprefix(PREFIX) for key in self._keys),
            trained_subsets=("all",),
            frame_stack=1,
            digest=digest_of(folder, action_steps),
            state_dim=env.state_dim,
            action_dim=env.action_dim,
            horizon=env.horizon,
            image_size=next(iter(config.image_features.values())).shape[-1],
            instruction=env.instruction,
            chunk=action_steps or getattr(config, "n_action_steps", 1),
            can_drop=config.type in CAN_DROP,
            reads_together=False,
        )

    def encode(self, views: Array, state: Array) -> Encoded:
        """(V, 3, H, W) uint8 to what the policy was trained on."""
        pictures = torch.from_numpy(views.astype(np.float32) / 255)
        look: dict[str, Any] = {key: pictures[at] for at, key in enumerate(self._keys)}
        look |= {OBS_STATE: torch.from_numpy(np.asarray(state, np.float32))}
        look |= {"task": self.spec.instruction}
        return Encoded(np.zeros((len(views), 1), np.float32), look[OBS_STATE].numpy(), look)

    def plan(self, look: dict[str, Any], mask: Array) -> Array:
        """(n, A): the next decisions."""
        batch = self._before(dict(look))
        with torch.inference_mode():
            if self.spec.can_drop:
                keys = [key for key, on in zip(self._keys, mask, strict=True) if on]
                batch[OBS_IMAGES] = Present([batch[k] for k in keys], batch[self._keys[0]])
                found = self._policy.model(batch)[0]
            else:
                found = self._policy.predict_action_chunk(batch)
            return np.clip(self._after(found)[0].numpy(), -1, 1).astype(np.float32)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        action = np.stack([self.plan(encoded.private, mask)[0] for mask in np.atleast_2d(masks)])
        unknown = np.full(len(action), np.nan, np.float32)
        return Readout(np.zeros((len(action), 1), np.float32), action, unknown)

    def supports(self, mask: Array) -> bool:
        return len(mask) == len(self._keys) and bool(self.spec.can_drop or np.all(mask))

    def reset(self, seed: int) -> ChunkPlayer:
        """A policy with randomness in it would be seeded here; ACT has none."""
        torch.manual_seed(seed)
        return ChunkPlayer(self)


class ChunkPlayer:
    """Looks again when the decisions of the last look are used up."""

    def __init__(self, policy: LeRobotPolicy) -> None:
        self._policy, self._left = policy, []

    @property
    def planned(self) -> int:
        return len(self._left)

    def act(self, encoded: Encoded, mask: Array) -> Array:
        if not self._left:
            steps = self._policy.spec.chunk
            self._left = list(self._policy.plan(encoded.private, mask)[:steps])
        return self._left.pop(0)

    def close(self) -> None:
        """There is nothing to free."""


def digest_of(folder: Path, action_steps: int | None) -> str:
    """A name for this version of the policy."""
    names = [*folder.glob("*.json"), *folder.glob("*.safetensors")]
    read = [each.read_bytes() for each in sorted(names) if each.name != "training.json"]
    return hashlib.sha256(b"".join(read) + str(action_steps).encode()).hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of LeRobot's, with config.json")
    parser.add_argument("--task", default="metaworld/hammer", help="where it acts, as in madviz")
    parser.add_argument("--action-steps", type=int, help="decisions from one look")
    parser.add_argument("--port", type=int, default=8000)
    asked = parser.parse_args()
    policy = LeRobotPolicy(asked.folder, asked.task, asked.action_steps)
    server = PolicyServer(policy, port=asked.port)
    print(f"{policy.spec.name} is at {server.address}", flush=True)
    server.run()


if __name__ == "__main__":
    main()
