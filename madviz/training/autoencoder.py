"""Trains the masked autoencoder over views on recorded frames.

Every update draws which tokens are kept (``agent/autoencoder.drawn_tokens``): of one view or of
several, whole or in part. The rate rises over a twentieth of the updates and falls as a cosine.
What is learned is a function of the frames, the configuration and the seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from madviz.agent.agent import autocast
from madviz.agent.autoencoder import (
    AutoencoderConfig,
    MultiViewAutoencoder,
    drawn_tokens,
    moving,
    reconstruction_loss,
    symlog,
)
from madviz.system.numbers import Rate, Steps, Weight, Width
from madviz.training.demonstrations import Dataset

WARM_UP = 0.05
"""Share of the updates in which the rate rises."""
MEAN_OF = 512
"""Frames that the mean picture of a camera is taken over."""


@dataclass(frozen=True)
class AutoencoderTraining:
    """How the autoencoder is trained."""

    updates: Steps = 6000
    """Gradient steps."""
    batch_size: Width = 32
    """Time steps in a gradient step, each with all its views."""
    learning_rate: Rate = 1e-3
    """AdamW's, at its highest."""
    reward_weight: Weight = 0.01
    """Of the squared error of the reward's symlog, beside the pictures'."""


def newest(views: Tensor) -> Float[Tensor, "B V 3 H W"]:
    """The last frame of stacks (B, V, C, H, W) uint8, from 0 to 1."""
    return views[:, :, -3:].float() / 255


def mean_pictures(data: Dataset, seed: int = 0) -> Float[Tensor, "V 3 H W"]:
    """The mean picture of every view, over ``MEAN_OF`` frames drawn by ``seed``."""
    rng = np.random.default_rng([seed, 11])
    index = rng.choice(len(data), min(MEAN_OF, len(data)), replace=False)
    return newest(data.views(index, 1)).mean(0)


def new_autoencoder(
    data: Dataset, config: AutoencoderConfig, seed: int, frame_stack: int = 3
) -> MultiViewAutoencoder:
    """One that has learned nothing and draws the mean pictures of ``data``."""
    torch.manual_seed(seed)
    return MultiViewAutoencoder(config, 3 * frame_stack, mean_pictures(data, seed))


def train_autoencoder(
    model: MultiViewAutoencoder,
    data: Dataset,
    config: AutoencoderTraining,
    seed: int,
    report: Callable[[int, float], None] = lambda update, loss: None,
) -> None:
    """All updates, in place; ``report`` hears of the mean loss of every hundred."""
    optimiser = torch.optim.AdamW(
        model.parameters(), lr=config.learning_rate, weight_decay=0.01, fused=True
    )
    rng = np.random.default_rng([seed, 13])
    generator = torch.Generator().manual_seed(seed)
    losses: list[float] = []
    model.train()
    for update in range(config.updates):
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * schedule(update / config.updates)
        index = rng.integers(0, len(data), config.batch_size)
        views, reward = data.views(index), data.column("rewards", index)
        with autocast():
            loss = autoencoder_loss(model, views, reward, generator, config.reward_weight)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        losses.append(loss.item())
        if len(losses) == 100:
            report(update + 1, float(np.mean(losses)))
            losses.clear()
    model.eval()


def autoencoder_loss(
    model: MultiViewAutoencoder,
    views: Tensor,
    reward: Float[Tensor, " B"],
    generator: torch.Generator,
    reward_weight: float,
) -> Float[Tensor, ""]:
    """Of a batch of stacks (B, V, C, H, W) uint8, under tokens that ``generator`` draws."""
    batch, count = views.shape[:2]
    keep = drawn_tokens(generator, batch, count, model.tokens_of_a_view)
    drawn, pictures = model(views, keep), newest(views)
    moves = moving(pictures, model.mean)
    loss = reconstruction_loss(drawn.pictures, pictures, moves, model.config.moving_weight)
    return loss + reward_weight * F.mse_loss(drawn.reward, symlog(reward))


def schedule(progress: float) -> float:
    """Share of the highest rate, at ``progress`` from 0 to 1."""
    rise = min(1.0, (progress + 1e-9) / WARM_UP)
    return rise * 0.5 * (1 + math.cos(math.pi * progress))
