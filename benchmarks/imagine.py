"""``benchmarks imagine``: does an autoencoder know what a missing camera would see?

Trains a masked autoencoder over views (``world_model/autoencoder.py``) on episodes of a task's
expert, and then hides one camera after the other, as a whole, on frames that it was not trained on.
What it draws of the hidden camera from the others is compared with what that camera saw, over the
pixels that move, beside two controls: the camera's mean picture; and the same network that is shown
the others' pictures *of another episode*, so that it knows how such pictures look and nothing of
now.

    hidden     from               imagined    mean picture    another episode
    third_b    first, third_a     16.5 dB     10.0 dB         10.0 dB        gain 6.5 dB
    third_a    first, third_b     15.3 dB     10.0 dB         10.0 dB        gain 5.2 dB
    third_b    first              14.1 dB     10.0 dB         10.0 dB        gain 4.1 dB

The figures are those of toy/reach (``results/imagine``). First person alone tells less: its picture
often does not show the target.

Imagined in earnest: at least ``ENOUGH`` dB above the better control, for every camera. With
``--policy``, nothing is trained: the autoencoder of that policy is judged.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.pretraining import (
    AutoencoderTraining,
    new_autoencoder,
    train_autoencoder,
)
from madviz.agent.agent import TorchPolicy
from madviz.agent.sizes import FEWEST_MOVING
from madviz.envs.registry import TaskName, make_env
from madviz.errors import UserError
from madviz.policies.checkpoint import PolicyName, load_policy
from madviz.policies.seeds import FIRST_SELECTION, FIRST_TRAINING, seeds_from
from madviz.runs.demonstrations import Dataset, Driver, record_episode
from madviz.subsets import every_mask, name_of
from madviz.system.numbers import Count, Seed
from madviz.types import Array, Environment
from madviz.world_model.autoencoder import (
    MultiViewAutoencoder,
    moving,
    newest,
    whole_views,
)
from madviz.world_model.mv_mae import DrawingMerge
from madviz.world_model.sizes import AutoencoderConfig

ENOUGH = 3.0
"""dB above both controls."""


@dataclass(frozen=True)
class ImagineConfig:
    """Measures what a masked autoencoder draws of a camera that is missing: one that is trained for
    it, or a policy's."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    policy: PolicyName | None = None
    """Judge what this policy draws, in its own task, and train nothing."""
    task: TaskName = "toy/reach"
    """The task whose cameras are imagined."""
    episodes: Count = 60
    """Episodes to train on: of the expert, a fifth of whose actions is random."""
    frames: Count = 200
    """Frames that are judged, of other episodes."""
    seed: Seed = 0
    """The seed of networks and batches."""
    training: AutoencoderTraining = field(default_factory=AutoencoderTraining)
    """How it is trained."""
    network: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    """Its sizes."""


def bench_imagine(config: ImagineConfig) -> dict[str, Any]:
    """The result of the module's table, by hidden camera and by what is seen. Raises UserError for
    a task with one camera, for a policy that draws nothing, and for more episodes than there are
    seeds."""
    if config.policy is not None:
        return _of_a_policy(config, config.policy)
    with closing(make_env(config.task)) as env:
        streams = tuple(camera.name for camera in env.spec.cameras)
        _check_streams(streams, config.task)
        train = recorded(env, streams, seeds_from(FIRST_TRAINING, config.episodes))
        judged = recorded(env, streams, _judged_seeds(config, env))
    began = time.process_time()
    model = new_autoencoder(train, config.network, config.seed)
    train_autoencoder(model, train, config.training, config.seed, _progress(config))
    trained = {
        "task": config.task,
        "episodes": config.episodes,
        "training": asdict(config.training),
        "network": asdict(config.network),
        "cpu_seconds": round(time.process_time() - began),
    }
    return trained | judgement(config, model, judged)


def _of_a_policy(config: ImagineConfig, name: str) -> dict[str, Any]:
    policy = load_policy(name)
    merge = policy.agent.encoder if isinstance(policy, TorchPolicy) else None
    if not isinstance(merge, DrawingMerge):
        raise UserError(
            f"expected a policy that draws pictures, found {name}; pick one of the methods mv-mae "
            "and mv-mwm (madviz list)"
        )
    spec = policy.spec
    _check_streams(spec.streams, spec.task)
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env:
        judged = recorded(env, spec.streams, _judged_seeds(config, env))
    model = merge.autoencoder
    of = {"task": spec.task, "policy": spec.name, "digest": spec.digest}
    return of | {"network": asdict(model.config)} | judgement(config, model, judged)


def _check_streams(streams: tuple[str, ...], found: str) -> None:
    if len(streams) < 2:
        raise UserError(f"expected a task with two or more cameras, found {found}")


def judgement(
    config: ImagineConfig, model: MultiViewAutoencoder, judged: Dataset
) -> dict[str, Any]:
    """The quality of each hidden camera's picture by ``model``, and whether it is enough."""
    rows = imagined(model, judged, config.frames, config.seed)
    others = [row for row in rows if row["from"].count("+") == len(judged.streams) - 2]
    return {
        "schema": 1,
        "frames": config.frames,
        "seed": config.seed,
        "parameters": sum(p.numel() for p in model.parameters()),
        "rows": rows,
        "least_gain": min(row["gain"] for row in others),
        "passes": all(row["gain"] >= ENOUGH for row in others),
    }


def recorded(env: Environment, streams: tuple[str, ...], seeds: range) -> Dataset:
    """Episodes of the expert, a fifth of whose actions is random."""
    data = Dataset(streams, len(seeds), env.spec.horizon)
    for seed in seeds:
        data.add(record_episode(env, streams, Driver(1.0, 0.2), seed))
    return data


def _judged_seeds(config: ImagineConfig, env: Environment) -> range:
    """Two more than have the frames, so that other frames are of other episodes."""
    count = max(2, math.ceil(config.frames / env.spec.horizon) + 2)
    return seeds_from(FIRST_SELECTION, count)


def imagined(
    model: MultiViewAutoencoder, data: Dataset, frames: int, seed: int
) -> list[dict[str, Any]]:
    """For every hidden camera and every subset of the others: dB over the pixels that move, as a
    mean over frames and in the worst one, with both controls and the gain over the better."""
    index, other = judged_frames(data, frames, seed)
    views, elsewhere = (data.views(each)[:, :, -model.channels :] for each in (index, other))
    truth = newest(views)
    moves = moving(truth, model.mean)
    mean = psnr(model.mean.expand_as(truth), truth, moves)
    rows = []
    for mask in every_mask(len(data.streams))[1:-1]:
        seen = drawn(model, views, mask)
        control = drawn(model, elsewhere, mask)
        table = {
            "imagined": psnr(seen, truth, moves),
            "mean_picture": mean,
            "other_episode": psnr(control, truth, moves),
        }
        for camera in np.flatnonzero(~mask):
            judged = moves[:, camera].sum((1, 2)) >= FEWEST_MOVING
            columns = {name: values[judged, camera] for name, values in table.items()}
            rows.append(_row(data.streams, mask, int(camera), columns))
    return rows


def psnr(
    drawn: Float[Tensor, "B V 3 H W"],
    pictures: Float[Tensor, "B V 3 H W"],
    where: Bool[Tensor, "B V H W"],
) -> Float[Tensor, "B V"]:
    """Peak signal-to-noise ratio in dB over the pixels ``where``, of pictures from 0 to 1; NaN
    where there are none. An error of 0.1 everywhere has 20 dB, one of 0.01 has 40."""
    error = (drawn.clamp(0, 1) - pictures).square().mean(2)
    mean = (error * where).sum((2, 3)) / where.sum((2, 3))
    return -10 * mean.log10()


def _row(
    streams: tuple[str, ...], mask: Array, camera: int, columns: dict[str, Tensor]
) -> dict[str, Any]:
    means = {name: round(float(values.mean()), 2) for name, values in columns.items()}
    better = max(means["mean_picture"], means["other_episode"])
    return {
        "hidden": streams[camera],
        "from": name_of(mask, streams),
        **means,
        "worst": round(float(columns["imagined"].min()), 2),
        "gain": round(means["imagined"] - better, 2),
        "n": len(columns["imagined"]),
    }


def judged_frames(data: Dataset, frames: int, seed: int) -> tuple[Array, Array]:
    """(frames,) decisions that are judged, and as many of other episodes."""
    rng = np.random.default_rng([seed, 17])
    index = rng.choice(len(data), min(frames, len(data)), replace=False)
    away = rng.integers(1, data.episodes, len(index)) * data.horizon
    return index, (index + away) % len(data)


@torch.inference_mode()
def drawn(model: MultiViewAutoencoder, views: Tensor, mask: Array) -> Tensor:
    """Every view as it is drawn from those in ``mask`` alone: (B, V, 3, H, W)."""
    parts = []
    for part in views.split(50):
        keep = whole_views(torch.from_numpy(mask), model.tokens_of_a_view, len(part))
        parts.append(model(part, keep).pictures)
    return torch.cat(parts)


def imagine_words(result: dict[str, Any]) -> str:
    """The module's table."""
    if "policy" in result:
        model = result["policy"]
    else:
        updates = result["training"]["updates"]
        seconds = result["cpu_seconds"]
        model = f"{updates} updates in {seconds} s of a processor"
    lines = [
        f"{result['task']}: {model}, {result['frames']} frames; dB over the pixels that move",
        f"{'hidden':10}{'from':22}{'imagined':>9}{'worst':>8}{'mean':>8}{'other':>8}{'gain':>8}",
    ]
    for row in result["rows"]:
        numbers = (row[key] for key in ("worst", "mean_picture", "other_episode", "gain"))
        lines.append(
            f"{row['hidden']:10}{row['from']:22}{row['imagined']:9.1f}"
            + "".join(f"{number:8.1f}" for number in numbers)
        )
    verdict = "imagined in earnest" if result["passes"] else "NOT imagined in earnest"
    lines.append(f"least gain, one camera hidden: {result['least_gain']:.1f} dB: {verdict}")
    return "\n".join(lines)


def _progress(config: ImagineConfig) -> Callable[[int, float], None]:
    def report(update: int, loss: float) -> None:
        if update % 500 == 0:
            words = f"[imagine] {update} of {config.training.updates} updates, loss {loss:.5f}"
            print(words, file=sys.stderr, flush=True)

    return report
