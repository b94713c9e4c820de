"""The agent: networks together, and the policy that lets anybody read them.

``TorchPolicy`` splits acting in two, because the page needs the halves apart: ``encode`` runs the
CNN once per stream, ``read`` forms the sum for every subset asked for and makes one pass through
actor and critic. Dropping a camera repeats only ``read`` (well under a millisecond for eight
subsets)."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from madviz.agent.merge import MERGES
from madviz.agent.networks import Actor, Critic, Encoder, NetworkConfig
from madviz.types import Array, Encoded, PolicySpec, Readout

_IMAGES_AT_ONCE = 192
"""Temporaries of this size are recycled by the allocator; larger ones are returned to the system
and paid for again, page by page: 768 images take half the time in four parts."""


class Agent(nn.Module):
    """Encoder, actor, twin critic, its target, and the temperature. There is no target encoder."""

    def __init__(self, config: NetworkConfig, temperature: float = 0.1) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.frame_stack)
        self.actor = Actor(config)
        self.critic = Critic(config)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.tensor(float(np.log(temperature))))

    def encode(self, views: Tensor) -> Tensor:
        """(B, V, C, H, W) uint8 -> (B, V, Z): every stream through the shared CNN, in one pass."""
        parts = views.flatten(0, 1).split(_IMAGES_AT_ONCE)
        return torch.cat([self.encoder(part) for part in parts]).unflatten(0, views.shape[:2])

    def acting_state(self) -> dict[str, Tensor]:
        """What a policy needs to act and to show Q: no target, no temperature."""
        kept = ("encoder.", "actor.", "critic.")
        return {k: v for k, v in self.state_dict().items() if k.startswith(kept)}


class TorchPolicy:
    """A trained agent behind the ``Policy`` protocol; deterministic, in float32."""

    def __init__(
        self, spec: PolicySpec, agent: Agent, merge: str = "sum", reward_scale: float = 1.0
    ) -> None:
        """``reward_scale`` is what training multiplied rewards by; Q is shown without it."""
        self.spec = spec
        self.agent = agent.eval()
        self._merge = MERGES[merge]
        self._reward_scale = reward_scale

    @torch.inference_mode()
    def encode(self, views: Array, state: Array) -> Encoded:
        features = self.agent.encode(torch.from_numpy(views)[None])[0]
        return Encoded(features.float().numpy(), np.asarray(state, np.float32))

    @torch.inference_mode()
    def read(self, encoded: Encoded, masks: Array) -> Readout:
        features = torch.from_numpy(encoded.features)[None]
        merged = self._merge(features, torch.from_numpy(np.atleast_2d(masks)))[:, 0]
        state = torch.from_numpy(encoded.state).expand(len(merged), -1)
        action = torch.tanh(self.agent.actor(merged, state)[0])
        q = torch.minimum(*self.agent.critic(merged, state, action)) / self._reward_scale
        return Readout(merged.numpy(), action.numpy(), q.numpy())

    def supports(self, mask: Array) -> bool:
        """A sum can be taken over any subset, the empty one included (state only)."""
        return len(mask) == len(self.spec.streams)


def random_policy(spec: PolicySpec, config: NetworkConfig, seed: int = 0) -> TorchPolicy:
    """An untrained policy, for tests and for timing."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return TorchPolicy(spec, Agent(config))


def optimisers(agent: Agent, lr: float) -> dict[str, torch.optim.Adam]:
    """The paper's four separate Adams."""
    parts: dict[str, Sequence[nn.Parameter]] = {
        "encoder": list(agent.encoder.parameters()),
        "actor": list(agent.actor.parameters()),
        "critic": list(agent.critic.parameters()),
        "temperature": [agent.log_temperature],
    }
    return {name: torch.optim.Adam(list(part), lr=lr, fused=True) for name, part in parts.items()}


def autocast() -> torch.autocast:
    """bfloat16 where the CPU multiplies it natively (AMX or AVX512-BF16), else plain float32."""
    return torch.autocast("cpu", torch.bfloat16, enabled=fast_bfloat16())


def fast_bfloat16() -> bool:
    """Whether this CPU has bfloat16 instructions."""
    flags = torch.cpu.get_capabilities()
    return bool(flags.get("amx_bf16") or flags.get("avx512_bf16"))
