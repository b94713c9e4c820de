"""Stand-ins for what is slow or rare: policies that need no training, environments that fail."""

from __future__ import annotations

import numpy as np

from madviz.envs.registry import SETTINGS
from madviz.errors import UserError
from madviz.types import Array, Encoded, PolicySpec, Readout


class FakePolicy:
    """Every stream's newest picture through one fixed random projection; heads are random, too."""

    def __init__(
        self,
        name: str = "toy-mad",
        setting: str = "three",
        *,
        method: str = "mad",
        seed: int = 0,
        width: int = 64,
        task: str = "toy/reach",
        actions: int = 2,
    ) -> None:
        streams = SETTINGS[setting].streams
        self.spec = PolicySpec(
            name, task, method, setting, "none", streams, ("all", *streams), digest=f"{name}{seed}"
        )
        rng = np.random.default_rng(seed)
        self._eyes = rng.normal(size=(3 * 21 * 21, width)).astype(np.float32) / 40
        self._hand = rng.normal(size=(width, actions)).astype(np.float32) / 8
        self._value = rng.normal(size=width).astype(np.float32)

    def encode(self, views: Array, state: Array) -> Encoded:
        pixels = views[:, -3:, ::4, ::4].reshape(len(views), -1) / np.float32(255)
        return Encoded(np.maximum(pixels @ self._eyes, 0), np.asarray(state, np.float32))

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        merged = np.atleast_2d(masks).astype(np.float32) @ encoded.features
        return Readout(merged, np.tanh(merged @ self._hand), merged @ self._value)

    def supports(self, mask: Array) -> bool:
        return len(mask) == len(self.spec.streams)


class NanPolicy(FakePolicy):
    """Breaks when a single stream is left."""

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        readout = super().read(encoded, masks)
        alone = np.atleast_2d(masks).sum(1) == 1
        readout.action[alone] = np.nan
        return readout


class AllOrNothing(FakePolicy):
    """A policy that cannot act unless every stream is there, as a frame-stacking one."""

    def supports(self, mask: Array) -> bool:
        return bool(np.all(mask))


def policies(name: str) -> FakePolicy:
    """A ``load_policy`` that knows four fakes."""
    table = {
        "toy-mad": FakePolicy,
        "toy-rgbd": lambda: FakePolicy("toy-rgbd", "three-rgbd"),
        "toy-other": lambda: FakePolicy("toy-other", seed=1, method="merged-only"),
        "toy-nan": lambda: NanPolicy("toy-nan"),
    }
    if name not in table:
        raise UserError(f"unknown policy {name!r}")
    return table[name]()
