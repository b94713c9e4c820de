"""``recorded:NAME``: stands where a policy would, for recordings that are looked at without one."""

from __future__ import annotations

import numpy as np

from madviz.envs.registry import env_spec
from madviz.recorded.known import SUITE
from madviz.types import Array, Encoded, PolicySpec, Readout

NO_POLICY = "none"
"""Its method."""
NONE_LABEL = "no policy"
"""Its name on a page."""
PREFIX = "recorded:"
SIDE = 8
"""A feature is the camera's newest picture, grey, with so many pixels a side."""


def is_no_policy(policy: str) -> bool:
    """True for the name that stands for recordings without a policy."""
    return policy.startswith(PREFIX)


def without_policy(task: str) -> str:
    """The reference of what stands in for the recordings ``task``."""
    return PREFIX + task.removeprefix(f"{SUITE}/")


class NoPolicy:
    """Decides nothing: its action is 0, whatever the cameras send."""

    def __init__(self, reference: str) -> None:
        """``reference`` is as ``without_policy`` makes it. Raises UserError for unknown names."""
        env = env_spec(f"{SUITE}/{reference.removeprefix(PREFIX)}")
        self._actions = env.action_dim
        self.spec = PolicySpec(
            name=reference,
            task=env.task,
            method=NO_POLICY,
            setting="three",
            recipe="recorded",
            streams=tuple(camera.name for camera in env.cameras),
            trained_subsets=("all",),
            frame_stack=1,
            digest=reference,
            state_dim=env.state_dim,
            action_dim=env.action_dim,
        )

    def encode(self, views: Array, state: Array) -> Encoded:
        """``views`` (V, 3, H, W) uint8."""
        edge = views.shape[-1] // SIDE * SIDE
        grey = views[:, :, :edge, :edge].mean(axis=1) / 255  # (V, 8 n, 8 n)
        small = grey.reshape(len(grey), SIDE, edge // SIDE, SIDE, edge // SIDE).mean(axis=(2, 4))
        return Encoded(small.reshape(len(small), SIDE * SIDE).astype(np.float32), state)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        """``masks`` (N, V) bool."""
        merged = masks.astype(np.float32) @ encoded.features
        action = np.zeros((len(masks), self._actions), np.float32)
        return Readout(merged, action, q=np.full(len(masks), np.nan, np.float32))

    def supports(self, mask: Array) -> bool:
        return True
