"""One full update of MAD, and the learner that keeps what it needs between updates.

    shift -> encode o' -> target                        nothing here has a gradient
    shift -> encode o -> critic losses -> critic and encoder step
                     '-> features, detached -> actor losses -> actor step -> temperature step
    target critic <- 0.99 target critic + 0.01 critic

The encoder learns from the critic's losses alone. The actor acts on features from before the critic
and encoder step and is judged by the critic from after it. On a CUDA device all of it is one CUDA
graph (``update_graph.py``).

A merge may bring a loss. A *penalty* is added to the critic's (VIB's bottleneck); an *own loss* has
an Adam of its own on the encoder, and comes after everything else, on freshly shifted pictures
(MVD's contrastive losses).

Speed on a CPU comes from the encoder's memory layout (``networks.py``), from bfloat16 where the
processor multiplies it natively, from one pass of the heads over all N x B rows, and from asking
autograd only for the gradients that a step uses: ``backward(inputs=...)``. Weights, optimisers and
the target critic's average stay in float32.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from madviz.agent.agent import Agent, fast_bfloat16, optimisers
from madviz.agent.augment import draw_shifts, shift
from madviz.agent.methods import Method
from madviz.agent.networks import squash
from madviz.agent.objectives import (
    Batch,
    actor_losses,
    critic_losses,
    td_target,
    temperature_losses,
    weighted,
)
from madviz.agent.update_graph import Draw, GraphedUpdate
from madviz.errors import UserError
from madviz.system.numbers import Rate, Share
from madviz.types import Array

LOSSES = ("critic_loss", "actor_loss", "temperature", "entropy")
"""The numbers that an update reports."""
Precision = Literal["auto", "float32", "bfloat16"]


@dataclass(frozen=True)
class LearningConfig:
    """How an agent learns from a batch; the defaults are the paper's."""

    alpha: Share = 0.8
    """Weight of the merged term; 1 - alpha is shared by the singular terms."""
    learning_rate: Rate = 5e-4
    """Four separate Adams share this rate: encoder, actor, critic, temperature."""
    target_rate: Share = 0.01
    """Share of the critic in its target's moving average, per update."""
    same_shift_for_views: bool = True
    """Shift all views of a sample alike (the paper), or each on its own (its code)."""
    precision: Precision = "auto"
    """Matrix products in updates: the paper has float32; ``auto`` takes bfloat16 where the device
    has instructions for it."""


class Learner:
    """An agent in training: its method, optimisers and generators."""

    loss_names: ClassVar[tuple[str, ...]] = LOSSES

    def __init__(
        self,
        agent: Agent,
        method: Method,
        streams: tuple[str, ...],
        config: LearningConfig | None = None,
        seed: int = 0,
    ) -> None:
        self.agent = agent.train()
        self.config = config or LearningConfig()
        self.method = method
        self.optimisers = optimisers(agent, self.config.learning_rate)
        if agent.encoder.own_optimiser:
            self.optimisers[agent.encoder.own_optimiser] = torch.optim.Adam(
                agent.encoder.parameters(), lr=self.config.learning_rate, fused=True
            )
        self.weights = method.weights(self.config.alpha)
        self._device = next(agent.parameters()).device
        self._masks = torch.from_numpy(method.masks(streams)).to(self._device)
        self._trained = np.flatnonzero(method.trained_rows(streams, self.config.alpha))
        self._reads = 1 if method.targets == "merged" else len(self._masks)
        self._rng = np.random.default_rng(seed)
        self._noise = torch.Generator().manual_seed(seed)
        self.low_precision = self.config.precision == "bfloat16" or (
            self.config.precision == "auto" and _fast_bfloat16(self._device)
        )
        if self._device.type == "cuda" and self.config.precision == "float32":
            torch.backends.cudnn.allow_tf32 = False  # 10 bits of 23 in convolutions, by default.
        self._average = get_ema_multi_avg_fn(1 - self.config.target_rate)
        self._graph = self._new_graph()

    def draw(self, batch: int) -> Draw:
        """The next update's randomness, for ``batch`` samples."""
        (rows, count), actions = self._masks.shape, self.agent.config.action_dim
        shape = (2, batch, count)
        same = self.config.same_shift_for_views
        shifts = draw_shifts(self._rng, shape, same)
        target_noise = torch.randn(self._reads, batch, actions, generator=self._noise)
        actor_noise = torch.randn(rows, batch, actions, generator=self._noise)
        merge = self.agent.encoder
        noise = (merge.noise(batch, self._noise), merge.noise(batch, self._noise))
        own_loss = None
        if merge.own_optimiser:
            own_loss = (draw_shifts(self._rng, shape, same), int(self._rng.integers(count)))
        return Draw(shifts, target_noise, actor_noise, noise, own_loss)

    def update(self, batch: Batch, draw: Draw | None = None) -> dict[str, float]:
        """One step of all four optimisers and of the target; returns named losses."""
        return named(self.step(batch, draw))

    def step(self, batch: Batch, draw: Draw | None = None) -> Tensor:
        """``update``, whose losses (4,) are not waited for; ``named`` reads them. On a CUDA device
        they are those of the newest update, in place."""
        draw = draw or self.draw(len(batch.action))
        return self._graph(batch, draw) if self._graph else self._step_all(batch, draw)

    def _new_graph(self) -> GraphedUpdate | None:
        # A merge's own loss chooses a view by number: a graph would always take the same.
        on_cuda = self._device.type == "cuda" and not self.agent.encoder.own_optimiser
        return GraphedUpdate(self._step_all, self._device) if on_cuda else None

    def _step_all(self, batch: Batch, draw: Draw) -> Tensor:
        agent = self.agent
        as_stored = batch
        batch = self._shifted(batch, draw.shifts)
        target = self._target(batch, draw)  # (R, B)
        with self._autocast():
            features, rows = agent.encoder.encode_and_merge(
                batch.views, self._masks, draw.merge_noise[0]
            )  # (B, V, Z), (N, B, Z)
            losses = critic_losses(agent, rows, batch.state, batch.action, target)  # (N,)
            critic = weighted(losses, self.weights)
        penalty = agent.encoder.penalty(features)
        self._step(critic if penalty is None else critic + penalty, "critic", "encoder")
        with self._autocast():
            # The features are those from before the step above, the critic is the one after it.
            noise = draw.actor_noise.to(self._device)  # (N, B, A)
            losses, log_prob = actor_losses(agent, rows, batch, noise, rows[: self._reads])
            actor = weighted(losses, self.weights)
        self._step(actor, "actor")
        temperature = weighted(temperature_losses(agent, log_prob), self.weights)
        self._step(temperature, "temperature")
        with torch.no_grad():
            self._average(list(agent.target.parameters()), list(agent.critic.parameters()), 0)
        if draw.own_loss is not None:
            self._own_step(as_stored, *draw.own_loss)
        with torch.no_grad():
            entropy = -log_prob[self._trained[0]].mean()  # of the merged row, where it is trained
            return torch.stack([critic, actor, agent.log_temperature.exp(), entropy])

    @torch.inference_mode()
    def act_all(self, views: Tensor, state: Tensor) -> Array:
        """(L, V, C, H, W) uint8 and (L, S) to drawn actions (L, A), to act in training.

        On all streams, except by a method that never learns to act on them: it takes one of its
        rows, drawn anew at every decision.
        """
        row = 0 if 0 in self._trained else int(self._rng.choice(self._trained))
        merge = self.agent.encoder
        drawn = merge.noise(len(views), self._noise)
        mask = self._masks[row : row + 1]  # (1, V)
        merged = merge.encode_and_merge(views.to(self._device), mask, drawn)[1][0]  # (L, Z)
        mean, log_std = self.agent.actor(merged, state.to(self._device))
        noise = torch.randn(mean.shape, generator=self._noise).to(self._device)
        return squash(mean, log_std, noise)[0].float().cpu().numpy()

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs to go on as if it had never stopped."""
        return {
            "agent": self.agent.state_dict(),
            "optimisers": {name: o.state_dict() for name, o in self.optimisers.items()},
            "rng": generator_state(self._rng),
            "noise": self._noise.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.agent.load_state_dict(state["agent"])
        for name, optimiser in self.optimisers.items():
            recorded = [group["capturable"] for group in optimiser.param_groups]
            optimiser.load_state_dict(state["optimisers"][name])
            for group, here in zip(optimiser.param_groups, recorded, strict=True):
                group["capturable"] = here  # Whatever device the state comes from.
        restore_generator(self._rng, state["rng"])
        self._noise.set_state(state["noise"])
        self._graph = self._new_graph()  # Optimisers have other tensors now.

    def _shifted(self, batch: Batch, both: Array) -> Batch:
        moved = {
            name: shift(getattr(batch, name).to(self._device), shifts, centred=True)
            for name, shifts in zip(("views", "next_views"), both, strict=True)
        }
        numbers = {
            name: getattr(batch, name).to(self._device)
            for name in ("state", "action", "reward", "discount", "next_state")
        }
        return replace(batch, **moved, **numbers)

    def _autocast(self) -> torch.autocast:
        # A context keeps its bfloat16 copies of the weights, so none may outlive an optimiser's
        # step, and none made without gradients may be met by a pass that needs them.
        return torch.autocast(self._device.type, torch.bfloat16, enabled=self.low_precision)

    def _own_step(self, batch: Batch, both: Array, positive: int) -> None:
        """The merge's own loss, on pictures that are shifted anew."""
        merge = self.agent.encoder
        batch = self._shifted(batch, both)
        loss = merge.own_loss(batch.views, batch.next_views, positive, self._autocast)
        self._step(loss, merge.own_optimiser)

    @torch.no_grad()
    def _target(self, batch: Batch, draw: Draw) -> Tensor:
        with self._autocast():
            masks = self._masks[: self._reads]  # (R, V)
            _, reads = self.agent.encoder.encode_and_merge(
                batch.next_views, masks, draw.merge_noise[1]
            )  # (R, B, Z)
            return td_target(self.agent, reads, batch, draw.target_noise.to(self._device))

    def _step(self, loss: Tensor, *names: str) -> None:
        """Gradients of the named networks alone, and their optimisers' steps."""
        chosen = [self.optimisers[name] for name in names]
        parameters: list[nn.Parameter] = []
        for optimiser in chosen:
            optimiser.zero_grad()
            parameters += [p for group in optimiser.param_groups for p in group["params"]]
        loss.backward(inputs=parameters)
        for optimiser in chosen:
            optimiser.step()


def named(losses: Tensor) -> dict[str, float]:
    """The losses that ``Learner.step`` returned, by name; waits for them."""
    return dict(zip(LOSSES, losses.tolist(), strict=True))


def generator_state(rng: np.random.Generator) -> str:
    """The state that ``restore_generator`` needs. Text, because it holds integers of 128 bits."""
    return json.dumps(rng.bit_generator.state)


def restore_generator(rng: np.random.Generator, state: Any) -> None:
    """From now on ``rng`` draws what the generator of ``state`` would have drawn. Raises UserError
    for a state that is no text, as older versions saved it in runs of the recipe ``light``."""
    if not isinstance(state, str):
        raise UserError(
            "expected a run that this version of madviz saved, found one that an older version "
            "saved, which cannot go on; begin it again with another --out"
        )
    rng.bit_generator.state = json.loads(state)


def _fast_bfloat16(device: torch.device) -> bool:
    """Whether ``device`` multiplies bfloat16 natively."""
    return torch.cuda.is_bf16_supported() if device.type == "cuda" else fast_bfloat16()
