"""Stand-ins for what is slow or rare: policies that need no training, environments that fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.networks import NetworkConfig
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


def random_policy(spec: PolicySpec, config: NetworkConfig, seed: int = 0) -> TorchPolicy:
    """MAD's networks, untrained."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return TorchPolicy(spec, Agent(config))


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


class Silent(FakePolicy):
    """Gives no answer while it is ``silent``, as a policy in another program may."""

    silent = False

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        if self.silent:
            raise UserError("expected an answer of the policy, found none; press play")
        return super().read(encoded, masks)


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


class ChunkPlayer:
    """Looks every few decisions; the time since the episode began is in every action, so that who
    forgets it, or mixes two episodes, is found out."""

    def __init__(self, policy: Chunked, seed: int) -> None:
        self._policy, self._seed, self._plan = policy, seed, list[Array]()
        self._taken = 0
        self.closed = False

    @property
    def planned(self) -> int:
        return len(self._plan)

    def act(self, encoded: Encoded, mask: Array) -> Array:
        if not self._plan:
            look = self._policy.read(encoded, mask[None]).action[0]
            self._policy.looks += 1
            self._plan = [look * 0.9**i for i in range(self._policy.spec.chunk)]
        self._taken += 1
        drift = np.float32(0.01 * self._taken + 0.01 * (self._seed % 7))
        return np.clip(self._plan.pop(0) + drift + self._policy.noise(), -1, 1)

    def close(self) -> None:
        self.closed = True


class Chunked(FakePolicy):
    """Takes four decisions from one look, and reads one set of cameras at a time."""

    def __init__(self, name: str = "toy-chunked") -> None:
        super().__init__(name)
        self.spec = replace(self.spec, chunk=4, reads_together=False)
        self.looks, self.read_rows = 0, 0
        self.players: list[ChunkPlayer] = []

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        self.read_rows += len(masks)
        merged = np.atleast_2d(masks).astype(np.float32) @ encoded.features
        action = np.tanh(0.05 * merged @ self._hand)  # Small: no action is cut off at 1.
        return Readout(merged, action, np.full(len(merged), np.nan, np.float32))

    def reset(self, seed: int) -> ChunkPlayer:
        self.players.append(ChunkPlayer(self, seed))
        return self.players[-1]

    def noise(self) -> float:
        """None: the seed fixes everything."""
        return 0.0


class Restless(Chunked):
    """Draws noise that no seed fixes."""

    _drawn = 0

    def noise(self) -> float:
        self._drawn += 1
        return 0.01 * (self._drawn % 3)
