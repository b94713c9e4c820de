"""The learner of the recipe ``mv-mwm``: an autoencoder, a world model, an actor and a critic.

    frames                --> autoencoder                          pictures, AdamW
    stretches of episodes --> its tokens, data --> world model     world, Adam
    beliefs, data         --> imagined decisions --> actor, critic  two Adams

Each has an optimiser of its own, and no loss reaches what stands before it. An imagination begins
at beliefs that are rebuilt over a frame stack, as the acting policy has them, under the views that
are present in a stretch: how many is drawn uniformly, then which.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from madviz.agent.agent import Agent, autocast
from madviz.runs.buffer import Stretch
from madviz.types import Array
from madviz.world_model.actor_critic import (
    BeliefActor,
    BeliefCritic,
    act,
    imagine,
    imagined_actor_loss,
    imagined_critic_loss,
    lambda_returns,
    reached,
)
from madviz.world_model.autoencoder import autoencoder_loss, symlog
from madviz.world_model.mv_mwm import WorldNetworks
from madviz.world_model.mv_mwm_options import MvMwmConfig
from madviz.world_model.rssm import Belief
from madviz.world_model.world import REWARD, Window, world_model_losses

LARGEST = {"pictures": 1.0, "world": 100.0, "actor": 100.0, "critic": 100.0}
"""Norms that gradients are cut to: the paper's 100, and 1 for the autoencoder."""


class WorldLearner:
    """An agent of the merge ``mv-mwm`` in training: its optimisers and its generator."""

    loss_names: ClassVar[tuple[str, ...]] = (
        "autoencoder_loss",
        "model_loss",
        "features_loss",
        "reward_loss",
        "reward_explained",
        "state_loss",
        "ahead_loss",
        "kl",
        "actor_loss",
        "critic_loss",
        "imagined_return",
        "imagined_reward",
        "entropy",
        "cloning_loss",
    )

    def __init__(self, agent: Agent, config: MvMwmConfig, gamma: float, seed: int = 0) -> None:
        self.agent = agent.train()
        self.config = config
        self.gamma = gamma
        assert isinstance(agent.encoder, WorldNetworks)
        assert isinstance(agent.actor, BeliefActor) and isinstance(agent.critic, BeliefCritic)
        assert isinstance(agent.target, BeliefCritic)
        self.net = agent.encoder
        self.actor = agent.actor
        self.critic = agent.critic
        self.target = agent.target
        self.parts: dict[str, nn.Module] = {
            "pictures": self.net.autoencoder,
            "world": self.net.world,
            "actor": self.actor,
            "critic": self.critic,
        }
        self.rates = {
            "pictures": config.autoencoder_rate,
            "world": config.world_rate,
            "actor": config.heads_rate,
            "critic": config.heads_rate,
        }
        self.optimisers: dict[str, torch.optim.Optimizer] = {
            name: torch.optim.Adam(part.parameters(), fused=True)
            for name, part in self.parts.items()
        }
        pictures = self.net.autoencoder.parameters()
        self.optimisers["pictures"] = torch.optim.AdamW(pictures, weight_decay=0.01, fused=True)
        self.set_learning_rates(0.0)
        self.updates = 0
        self._device = next(agent.parameters()).device
        self._groups = self.net.world.rssm.config.groups
        self._generator = torch.Generator().manual_seed(seed)

    # --- Learning -------------------------------------------------------------------------------

    def set_learning_rates(self, progress: float) -> None:
        """Sets all rates to what is due at ``progress`` from 0 to 1."""
        share = 1 - progress * (1 - self.config.rate_floor)
        for name, optimiser in self.optimisers.items():
            for group in optimiser.param_groups:
                group["lr"] = share * self.rates[name]

    def learn_pictures(
        self, views: UInt8[Tensor, "B V 3 H W"], reward: Float[Tensor, " B"]
    ) -> dict[str, float]:
        """One step of the autoencoder."""
        self.agent.train()
        views = views.to(self._device)
        reward = reward.to(self._device)
        with autocast():
            loss = autoencoder_loss(self.net.autoencoder, views, reward, self._generator)
        self._step("pictures", loss)
        return {"autoencoder_loss": loss.item()}

    def update(
        self,
        stretch: Stretch,
        labels: Float[Tensor, "L+1 E A"] | None = None,
        imagines: bool = True,
    ) -> dict[str, float]:
        """One step of the world model and then, if it ``imagines``, of actor and critic; returns
        named losses. ``labels``: an expert's actions in the last E samples of ``stretch``."""
        # An evaluation before may have left it otherwise, and PyTorch's transformers compute
        # differently then: a resumed run, which was not evaluated, would go on elsewhere.
        self.agent.train()
        moved = {name: tensor.to(self._device) for name, tensor in vars(stretch).items()}
        window = self._window(replace(stretch, **moved))
        frames, batch = window.present.shape[:2]
        noise = self._uniform(frames + len(window.action), batch, self._groups)  # (T + L, B, G)
        losses = world_model_losses(self.net.world, window, noise, self.config.kl_weight)
        total = torch.stack(list(losses.values())).sum()
        self._step("world", total)
        named = {f"{name}_loss": loss.item() for name, loss in losses.items()}
        named["model_loss"] = total.item()
        named["reward_explained"] = _explained(named["reward_loss"], window.reward)
        named["kl"] = named.pop("kl_loss") / max(self.config.kl_weight, 1e-9)
        if not imagines:
            return named
        named |= self._imagine(window, labels)
        self.updates += 1
        if self.updates % self.config.target_every == 0:
            self.target.load_state_dict(self.critic.state_dict())
        return named

    def _imagine(self, window: Window, labels: Tensor | None) -> dict[str, float]:
        """One step of actor and critic, from beliefs of ``window``."""
        config = self.config
        belief, state = self._starts(window)  # (L + 1) B samples
        cloning = torch.zeros((), device=self._device)
        if labels is not None:
            cloning = self._cloning_loss(belief, state, labels.to(self._device))
        belief, state = self.subsample(belief, state)
        with frozen(self.net.world, self.target):
            drawn = self._noise(len(state))
            imagined = imagine(self.net.world, self.actor, belief, state, drawn, self.gamma)
            value = self.target.value(imagined.feature[1:], imagined.state[1:])  # (H, B)
            returns = lambda_returns(imagined.reward, imagined.discount, value, config.mixture)
            weight = reached(imagined.discount)
            loss = imagined_actor_loss(returns, imagined.entropy, weight, config.entropy_weight)
            self._step("actor", loss + config.cloning_weight * cloning)
        expected = self.critic.value(imagined.feature[:-1].detach(), imagined.state[:-1].detach())
        critic = imagined_critic_loss(expected, returns, weight)
        self._step("critic", critic)
        return {
            "actor_loss": loss.item(),
            "critic_loss": critic.item(),
            "imagined_return": returns[0].mean().item(),
            "imagined_reward": imagined.reward.mean().item(),
            "entropy": imagined.entropy.mean().item(),
            "cloning_loss": cloning.item(),
        }

    def _cloning_loss(self, belief: Belief, state: Tensor, labels: Tensor) -> Tensor:
        """Squared error of the actor's likeliest action, a mean over the last E samples."""
        steps, labelled, _ = labels.shape
        feature, felt = (
            x.unflatten(0, (steps, -1))[:, -labelled:] for x in (belief.feature, state)
        )  # (L + 1, E, Z), (L + 1, E, S)
        middle, _ = self.actor(feature, felt)
        return (torch.tanh(middle) - labels).square().mean()

    @torch.no_grad()
    def _starts(self, window: Window) -> tuple[Belief, Tensor]:
        """Beliefs and states at the last L + 1 frames, each rebuilt over its own stack; time
        first."""
        count = len(window.state)  # L + 1
        stack = len(window.present) - count + 1
        # The stack of the frame i begins at the frame i: its t-th frames are those from t on.
        frames = [window.present[t : t + count].flatten(0, 1) for t in range(stack)]
        stacks = torch.stack(frames)  # (stack, (L + 1) B, E)
        noise = self._uniform(*stacks.shape[:2], self._groups)
        return self.net.world.rssm.observe(stacks, noise), window.state.flatten(0, 1)

    def subsample(self, belief: Belief, state: Tensor) -> tuple[Belief, Tensor]:
        """Those that are imagined from."""
        many = self.config.imagined_starts
        if not many or many >= len(state):
            return belief, state
        which = torch.randperm(len(state), generator=self._generator)[:many].to(self._device)
        chosen = Belief(belief.deterministic[which], belief.latent[which], belief.logits[which])
        return chosen, state[which]

    # --- Tokens ---------------------------------------------------------------------------------

    def _window(self, stretch: Stretch) -> Window:
        """Tokens of all views, and what is read of those that are present."""
        frames = stretch.frames  # (T, B, V, 3, H, W)
        with torch.no_grad(), autocast():
            tokens = self.net.autoencoder.all_tokens(frames.flatten(0, 1))  # (T * B, V, P, W)
            tokens = tokens.unflatten(0, frames.shape[:2])
            features = self._features(tokens[-len(stretch.state) :])  # (L + 1, B, M, W)
        present = drawn_views(self._generator, *frames.shape[1:3]).to(self._device)
        return Window(
            self._embedded(tokens, present),
            features.float(),
            stretch.state,
            stretch.action,
            stretch.reward,
            stretch.follows,
        )

    def _features(self, tokens: Float[Tensor, "T B N P W"]) -> Float[Tensor, "T B K W"]:
        """The tokens of N views, after they have seen each other."""
        seen = self.net.autoencoder.features(tokens.flatten(0, 1).flatten(1, 2))
        return seen.unflatten(0, tokens.shape[:2])

    def _embedded(
        self, tokens: Float[Tensor, "T B V P W"], present: Bool[Tensor, "B V"]
    ) -> Float[Tensor, "T B E"]:
        """The embeddings that the world model reads of the views that are present in each sample;
        samples with as many of them go through the networks together."""
        parts = []
        order = []
        for size in present.sum(1).unique():
            which = (present.sum(1) == size).nonzero().flatten()
            seen = [tokens[:, b, present[b]] for b in which.tolist()]  # (T, N, P, W) of each
            with torch.no_grad(), autocast():
                features = self._features(torch.stack(seen, 1))
            read = self.net.world.embed(features.float().flatten(0, 1))  # (T * n, E)
            parts.append(read.unflatten(0, features.shape[:2]))
            order.append(which)
        return torch.cat(parts, 1)[:, torch.cat(order).argsort()]  # Samples in their old order.

    # --- Acting, and going on -------------------------------------------------------------------

    @torch.inference_mode()
    def act_all(self, views: Tensor, state: Tensor) -> Array:
        """(L, V, C, H, W) uint8 and (L, S) to drawn actions (L, A), on all views."""
        self.agent.eval()
        mask = torch.ones(1, views.shape[1], dtype=torch.bool, device=self._device)
        belief = self.net.encode_and_merge(views.to(self._device), mask)[1][0]  # (L, Z)
        noise = self._uniform(len(views), self.agent.config.action_dim)
        return act(self.actor, belief, state.to(self._device), noise)[0].cpu().numpy()

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs to go on as if it had never stopped."""
        return {
            "agent": self.agent.state_dict(),
            "optimisers": {
                name: optimiser.state_dict() for name, optimiser in self.optimisers.items()
            },
            "generator": self._generator.get_state(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.agent.load_state_dict(state["agent"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
        self._generator.set_state(state["generator"])
        self.updates = state["updates"]

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self._generator).to(self._device)

    def _noise(self, batch: int) -> tuple[Tensor, Tensor]:
        horizon = self.config.horizon
        action = self._uniform(horizon, batch, self.agent.config.action_dim)
        return action, self._uniform(horizon, batch, self._groups)

    def _step(self, name: str, loss: Tensor) -> None:
        optimiser = self.optimisers[name]
        parameters = list(self.parts[name].parameters())
        optimiser.zero_grad(set_to_none=True)
        loss.backward(inputs=parameters)
        torch.nn.utils.clip_grad_norm_(parameters, LARGEST[name])
        optimiser.step()


def _explained(loss: float, reward: Tensor) -> float:
    """Share of the variance of the rewards' symlog that is predicted; 1 is all of it."""
    return 1 - 2 * loss / REWARD / max(symlog(reward).var().item(), 1e-9)


def drawn_views(generator: torch.Generator, batch: int, views: int) -> Bool[Tensor, "B V"]:
    """Which views are present in each sample: of 1 to V, each number as likely, whichever ones."""
    count = torch.randint(1, views + 1, (batch,), generator=generator)
    order = torch.rand(batch, views, generator=generator).argsort(1).argsort(1)
    return order < count[:, None]


@contextmanager
def frozen(*modules: nn.Module) -> Iterator[None]:
    """Weights of ``modules`` are data meanwhile: gradients pass through, and are kept of none."""
    weights = [p for module in modules for p in module.parameters() if p.requires_grad]
    for weight in weights:
        weight.requires_grad_(False)
    try:
        yield
    finally:
        for weight in weights:
            weight.requires_grad_(True)
