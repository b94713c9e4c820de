"""MAD's update as one would first write it down: the reference of ``benchmarks update``.

One view after the other goes through a contiguous float32 CNN, after a shift by ``grid_sample``;
the merged and every singular feature go through actor and critic one by one, and each loss is added
to the sum as the paper writes it. Nothing in it is slow on purpose (no gradient is computed that
is not used, targets need no graph), and it passes the same test of formulas as the fast learner.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor
from torch.nn import functional as F

from madviz.agent.agent import Agent
from madviz.agent.networks import Encoder, squash
from madviz.agent.objectives import Batch
from madviz.agent.update import Draw, LearningConfig


class NaiveLearner:
    """The same ``update`` as ``Learner``, for MAD with every single stream as a singular row."""

    def __init__(self, agent: Agent, config: LearningConfig | None = None) -> None:
        """Learns from a copy of ``agent``."""
        self.agent = copy.deepcopy(agent)
        self._encoder.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        self.config = config or LearningConfig()
        parts = (self.agent.encoder, self.agent.actor, self.agent.critic)
        lr = self.config.learning_rate
        self.encoder_optimiser, self.actor_optimiser, self.critic_optimiser = (
            torch.optim.Adam(part.parameters(), lr=lr) for part in parts
        )
        self.temperature_optimiser = torch.optim.Adam([self.agent.log_temperature], lr=lr)

    def update(self, batch: Batch, draw: Draw) -> dict[str, float]:
        """One full update; the order of steps is the paper's code's."""
        features = self._encode(batch.views, draw.shifts[0])
        with torch.no_grad():
            next_merged = torch.stack(self._encode(batch.next_views, draw.shifts[1])).sum(0)
            target = self._target(batch, next_merged, draw.target_noise[0])
        critic_loss = self._critic_loss(batch, features, target)
        self.critic_optimiser.zero_grad()
        self.encoder_optimiser.zero_grad()
        critic_loss.backward()
        self.critic_optimiser.step()
        self.encoder_optimiser.step()

        actor_loss, temperature_loss = self._actor_loss(
            batch, [feature.detach() for feature in features], draw.actor_noise
        )
        self.actor_optimiser.zero_grad()
        actor_loss.backward()
        self.actor_optimiser.step()
        self.temperature_optimiser.zero_grad()
        temperature_loss.backward()
        self.temperature_optimiser.step()

        pairs = zip(self.agent.critic.parameters(), self.agent.target.parameters(), strict=True)
        for online, slow in pairs:
            rate = self.config.target_rate
            slow.data.copy_(rate * online.data + (1 - rate) * slow.data)
        return {"critic_loss": critic_loss.item(), "actor_loss": actor_loss.item()}

    @property
    def _encoder(self) -> Encoder:
        """A sum's encoder is the CNN itself."""
        assert isinstance(self.agent.encoder, Encoder)
        return self.agent.encoder

    def _encode(self, views: Tensor, shifts: object) -> list[Tensor]:
        """(B, V, C, H, W) -> the features (B, Z) of every view."""
        moved = torch.as_tensor(shifts, device=views.device)
        dtype = self._encoder.conv1.weight.dtype
        count = views.shape[1]
        return [self._cnn(_shift(views[:, v].to(dtype), moved[:, v])) for v in range(count)]

    def _cnn(self, pixels: Tensor) -> Tensor:
        cnn = self._encoder
        x = F.relu(cnn.conv1(pixels / 255 - 0.5))
        x = F.relu(cnn.conv3(F.relu(cnn.conv2(x))))
        return x.flatten(1)

    def _target(self, batch: Batch, merged: Tensor, noise: Tensor) -> Tensor:
        mean, log_std = self.agent.actor(merged, batch.next_state)
        action, log_prob = squash(mean, log_std, noise.to(mean.device))
        q = torch.min(*self.agent.target(merged, batch.next_state, action))
        return batch.reward + batch.discount * (q - self.agent.log_temperature.exp() * log_prob)

    def _critic_loss(self, batch: Batch, features: list[Tensor], target: Tensor) -> Tensor:
        def error(feature: Tensor) -> Tensor:
            q1, q2 = self.agent.critic(feature, batch.state, batch.action)
            return F.mse_loss(q1, target) + F.mse_loss(q2, target)

        merged = torch.stack(features).sum(0)
        alpha = self.config.alpha
        singular = sum(error(feature) for feature in features)
        return alpha * error(merged) + (1 - alpha) / len(features) * singular

    def _actor_loss(
        self, batch: Batch, features: list[Tensor], noise: Tensor
    ) -> tuple[Tensor, Tensor]:
        merged = torch.stack(features).sum(0)
        alpha = self.config.alpha
        temperature = self.agent.log_temperature.exp()
        self.agent.critic.requires_grad_(False)
        actor_loss = temperature_loss = torch.zeros((), device=merged.device)
        for row, feature in enumerate([merged, *features]):
            weight = alpha if row == 0 else (1 - alpha) / len(features)
            mean, log_std = self.agent.actor(feature, batch.state)
            action, log_prob = squash(mean, log_std, noise[row].to(mean.device))
            q = torch.min(*self.agent.critic(merged, batch.state, action))
            actor_loss = actor_loss + weight * (temperature.detach() * log_prob - q).mean()
            entropy_gap = -log_prob.detach() + self.agent.config.action_dim
            temperature_loss = temperature_loss + weight * (temperature * entropy_gap).mean()
        self.agent.critic.requires_grad_(True)
        return actor_loss, temperature_loss


def _shift(images: Tensor, shifts: Tensor, pad: int = 4) -> Tensor:
    """(B, C, H, W) images and whole pixels (B, 2) -> images padded and sampled anew."""
    size = images.shape[-1]
    padded = F.pad(images, (pad, pad, pad, pad), mode="replicate")
    step = 2 / (size + 2 * pad)
    ends = (-1 + step / 2, 1 - step / 2)
    kind = {"dtype": images.dtype, "device": images.device}
    line = torch.linspace(*ends, size + 2 * pad, **kind)[:size]
    y, x = torch.meshgrid(line, line, indexing="ij")
    offset = (shifts + pad).to(images.dtype) * step
    grid = torch.stack([x, y], -1) + offset.flip(-1)[:, None, None]
    return F.grid_sample(padded, grid, padding_mode="zeros", align_corners=False)
