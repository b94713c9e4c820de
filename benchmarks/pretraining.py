"""Trains the masked autoencoder over views on recorded frames.

Every update draws which tokens are kept (``autoencoder.drawn_tokens``): of one view or of
several, whole or in part. The rate rises over a twentieth of the updates and falls as a cosine.
What is learned is a function of the frames, the configuration and the seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from madviz.agent.agent import autocast
from madviz.runs.demonstrations import Dataset
from madviz.system.numbers import Rate, Steps, Width
from madviz.world_model.autoencoder import MultiViewAutoencoder, autoencoder_loss, newest
from madviz.world_model.sizes import AutoencoderConfig

WARM_UP = 0.05
"""Share of the updates in which the rate rises."""


@dataclass(frozen=True)
class AutoencoderTraining:
    """How the autoencoder is trained."""

    updates: Steps = 4000
    """Gradient steps."""
    batch_size: Width = 16
    """Time steps in a gradient step, each with all its views."""
    learning_rate: Rate = 1e-3
    """AdamW's, at its highest."""


def new_autoencoder(
    data: Dataset, config: AutoencoderConfig, seed: int, frame_stack: int = 3
) -> MultiViewAutoencoder:
    """One that has learned nothing and draws the mean pictures of ``data``."""
    torch.manual_seed(seed)
    mean = newest(data.usual_views()).mean(0)  # (V, 3, H, W)
    return MultiViewAutoencoder(config, 3 * frame_stack, mean)


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
        views = data.views(index)
        reward = data.column("rewards", index)
        with autocast():
            loss = autoencoder_loss(model, views, reward, generator)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        losses.append(loss.item())
        if len(losses) == 100:
            report(update + 1, float(np.mean(losses)))
            losses.clear()
    model.eval()


def schedule(progress: float) -> float:
    """Share of the highest rate, at ``progress`` from 0 to 1."""
    rise = min(1.0, (progress + 1e-9) / WARM_UP)
    return rise * 0.5 * (1 + math.cos(math.pi * progress))
