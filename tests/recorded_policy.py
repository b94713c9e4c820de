"""A policy without a network for the recordings that were named last."""

from __future__ import annotations

import numpy as np

from madviz.envs.registry import env_spec
from madviz.recorded.known import known_recordings
from madviz.types import Array, Encoded, PolicySpec, Readout


class Bright:
    """Each number of its action is the mean brightness of the present cameras, less a half."""

    def __init__(self) -> None:
        env = env_spec(list(known_recordings())[-1])
        self.spec = PolicySpec(
            name="bright",
            task=env.task,
            method="pixels",
            setting="three",
            recipe="by hand",
            streams=tuple(camera.name for camera in env.cameras),
            trained_subsets=("all",),
            frame_stack=1,
            digest="bright-1",
            state_dim=env.state_dim,
            action_dim=env.action_dim,
        )

    def encode(self, views: Array, state: Array) -> Encoded:
        """``views`` (V, 3, H, W) uint8."""
        level = views.mean(axis=(1, 2, 3))[:, None] / 255
        return Encoded(np.repeat(level, self.spec.action_dim, 1).astype(np.float32), state)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        """``masks`` (N, V) bool."""
        merged = masks.astype(np.float32) @ encoded.features
        action = np.clip(merged / np.maximum(masks.sum(1, keepdims=True), 1) - 0.5, -1, 1)
        return Readout(merged, action, q=np.full(len(masks), np.nan, np.float32))

    def supports(self, mask: Array) -> bool:
        return True


def make() -> Bright:
    """The factory."""
    return Bright()
