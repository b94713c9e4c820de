"""The agent: networks together, and the policy that lets anybody read them.

``TorchPolicy`` splits acting in two, because the page needs the halves apart: ``encode`` runs the
CNN once per stream, ``read`` merges for every subset asked for and makes one pass through actor and
critic. Dropping a camera repeats only ``read`` (well under a millisecond for eight sums)."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor, nn

from madviz.agent.merges.merge_table import MERGES, merge_class
from madviz.agent.networks import Actor, Critic, NetworkConfig
from madviz.errors import UserError
from madviz.subsets import name_of
from madviz.types import Array, Encoded, Future, PolicySpec, Readout


class Agent(nn.Module):
    """The encoder, which is a merge, actor, twin critic, its target, and the temperature.

    There is no target encoder."""

    def __init__(
        self,
        config: NetworkConfig,
        temperature: float = 0.1,
        merge: str = "sum",
        streams: tuple[str, ...] = (),
    ) -> None:
        """``merge`` is a row of ``MERGES``; the networks of some are built for their ``streams``,
        and of some with ``config.own``. Raises UserError for an unknown merge."""
        super().__init__()
        self.config = config
        self.merge_name = merge
        self.streams = streams
        self.encoder = merge_class(merge)(config, streams)
        self.actor, self.critic = self.encoder.heads(config)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.tensor(float(np.log(temperature))))

    def scale_state(self, mean: tuple[float, ...], spread: tuple[float, ...]) -> None:
        """From now on the heads read the state minus ``mean`` in units of ``spread``; both are as
        long as what they read of it."""
        self.config = replace(self.config, state_mean=mean, state_spread=spread)
        for module in self.modules():
            if isinstance(module, Actor | Critic):
                module.config = self.config

    def acting_state(self) -> dict[str, Tensor]:
        """The weights that a policy needs to act and to show Q: no target, no temperature."""
        parts = ("encoder.", "actor.", "critic.")
        return {k: v for k, v in self.state_dict().items() if k.startswith(parts)}


class TorchPolicy:
    """A trained agent behind the ``Policy`` protocol; deterministic, in float32."""

    def __init__(self, spec: PolicySpec, agent: Agent, reward_scale: float = 1.0) -> None:
        """``reward_scale`` is what training multiplied rewards by; Q is shown without it."""
        self.spec = spec
        self.agent = agent.eval()
        self._reward_scale = reward_scale

    @torch.inference_mode()
    def encode(self, views: UInt8[Array, "V C H W"], state: Shaped[Array, " S"]) -> Encoded:
        """Every stream through the networks, once. ``private`` holds the merge's own features and
        its noise, where the rows of ``features`` are not all there is."""
        merge = self.agent.encoder
        pictures = torch.from_numpy(views)[None]  # (1, V, C, H, W)
        features = merge.encode_to_act(pictures)
        noise = merge.noise_to_act(pictures)
        shown = merge.feature_of_each(features)[0]  # (V, Z)
        private = None if shown.shape == features.shape[1:] and noise is None else (features, noise)
        return Encoded(shown.float().numpy(), np.asarray(state, np.float32), private)

    @torch.inference_mode()
    def read(self, encoded: Encoded, masks: Bool[Array, "*N V"]) -> Readout:
        """All N subsets in one pass. Raises UserError for one that this policy does not
        support."""
        masks = np.atleast_2d(masks)
        for mask in masks:
            if not self.supports(mask):
                raise self._cannot(mask)
        features, noise = encoded.private or (torch.from_numpy(encoded.features)[None], None)
        merge = self.agent.encoder
        rows = merge.rows(features, torch.from_numpy(masks), noise)[:, 0]  # (N, Z)
        state = torch.from_numpy(encoded.state).expand(len(rows), -1)  # (N, S)
        action = torch.tanh(self.agent.actor(rows, state)[0])  # (N, A)
        q = torch.minimum(*self.agent.critic(rows, state, action)) / self._reward_scale
        return Readout(merge.merged_feature(rows).numpy(), action.numpy(), q.numpy())

    @torch.inference_mode()
    def act_together(
        self,
        views: UInt8[Array, "B V C H W"],
        state: Float[Array, "B S"],
        masks: Bool[Array, "B V"],
    ) -> Float[Array, "B A"]:
        """The actions of B episodes, each read on its own subset: those of ``encode`` and ``read``,
        but for rounding, with one pass through the networks and no Q."""
        merge = self.agent.encoder
        pictures = torch.from_numpy(views)
        present = torch.from_numpy(masks)
        features = merge.encode_to_act(pictures)
        each = [slice(i, i + 1) for i in range(len(views))]  # A merge's noise is one episode's.
        rows = [
            merge.rows(features[i], present[i], merge.noise_to_act(pictures[i]))[0] for i in each
        ]
        mean, _ = self.agent.actor(torch.cat(rows), torch.from_numpy(state))  # (B, A)
        return torch.tanh(mean).numpy()

    @property
    def imagines(self) -> bool:
        """Whether it can draw what a missing camera would see."""
        return self.agent.encoder.draws

    @torch.inference_mode()
    def imagine(self, encoded: Encoded, mask: Bool[Array, " V"]) -> UInt8[Array, "V H W 3"]:
        """The newest frame of every stream, drawn from those in ``mask`` alone. Raises UserError
        where the policy does not support ``mask`` or does not draw (``imagines``)."""
        self._must_draw()
        if not self.supports(mask):
            raise self._cannot(mask)
        features, _ = encoded.private
        return _bytes(self.agent.encoder.imagined(features, torch.from_numpy(mask))[0])

    def mean_pictures(self) -> UInt8[Array, "V H W 3"]:
        """The mean picture of every stream in training. Raises UserError for a policy that does
        not draw."""
        self._must_draw()
        return _bytes(self.agent.encoder.mean_pictures())

    @property
    def foresees(self) -> bool:
        """Whether it can go on without pictures, in a world model of its own."""
        return self.agent.encoder.foresees

    @torch.inference_mode()
    def foresee(self, encoded: Encoded, mask: Bool[Array, " V"], decisions: int) -> Future:
        """The likeliest course of the next ``decisions``, begun from the streams in ``mask`` alone.
        Raises UserError where the policy does not support ``mask`` or has no world model."""
        if not self.foresees:
            raise UserError(
                f"expected a policy with a world model, found {self.spec.name}, whose merge "
                f"{self.agent.merge_name!r} has none; pick one of the method mv-mwm"
            )
        if not self.supports(mask):
            raise self._cannot(mask)
        features, _ = encoded.private
        state = torch.from_numpy(encoded.state)[None]  # (1, S)
        pictures, reward, action = self.agent.encoder.foreseen(
            self.agent.actor, features, torch.from_numpy(mask), state, decisions
        )
        rewards = reward[:, 0].numpy() / self._reward_scale
        return Future(_bytes(pictures[:, 0]), rewards, action[:, 0].numpy())

    def _must_draw(self) -> None:
        if not self.imagines:
            raise UserError(
                f"expected a policy that draws pictures, found {self.spec.name}, whose merge "
                f"{self.agent.merge_name!r} does not; pick one of the methods mv-mae and mv-mwm"
            )

    def supports(self, mask: Array) -> bool:
        """Whether there is a place for every stream, and the merge can do without the absent."""
        right_length = len(mask) == len(self.spec.streams)
        return right_length and MERGES[self.agent.merge_name].support.allows(mask)

    def _cannot(self, mask: Array) -> UserError:
        streams = self.spec.streams
        found = repr(name_of(mask, streams)) if len(mask) == len(streams) else f"{len(mask)} marks"
        return UserError(
            f"{self.spec.name} expects {MERGES[self.agent.merge_name].support.words} of "
            f"{', '.join(streams)}, found {found}; bring the missing cameras back"
        )


def _bytes(pictures: Float[Tensor, "*N 3 H W"]) -> UInt8[Array, "*N H W 3"]:
    """Pictures from 0 to 1 as they are shown."""
    return (255 * pictures).round().byte().movedim(-3, -1).contiguous().numpy()


def optimisers(agent: Agent, lr: float) -> dict[str, torch.optim.Adam]:
    """The paper's four separate Adams."""
    parts: dict[str, Sequence[nn.Parameter]] = {
        "encoder": list(agent.encoder.parameters()),
        "actor": list(agent.actor.parameters()),
        "critic": list(agent.critic.parameters()),
        "temperature": [agent.log_temperature],
    }
    recorded = agent.log_temperature.device.type == "cuda"  # In a graph, see update_graph.py.
    return {
        name: torch.optim.Adam(list(part), lr=lr, fused=True, capturable=recorded)
        for name, part in parts.items()
    }


def autocast() -> torch.autocast:
    """bfloat16 where the CPU multiplies it natively (AMX or AVX512-BF16), else plain float32."""
    return torch.autocast("cpu", torch.bfloat16, enabled=fast_bfloat16())


def fast_bfloat16() -> bool:
    """Whether this CPU has bfloat16 instructions."""
    flags = torch.cpu.get_capabilities()
    return bool(flags.get("amx_bf16") or flags.get("avx512_bf16"))
