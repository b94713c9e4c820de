"""``benchmarks update``: one full update of MAD, ours and the naive one by turns in one run.

Both learn from the same transitions, in memory already, with the same random numbers and as many
threads; what is timed is shift, encoding, losses, four optimisers' steps and the target's average.
Machines differ and are busy, so the figure to compare is the ratio of the medians.
"""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from statistics import median
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from benchmarks.memory import HERE, kilobytes
from benchmarks.naive import NaiveLearner
from madviz.agent.agent import Agent
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.agent.objectives import Batch
from madviz.agent.update import Learner, LearningConfig, Precision
from madviz.agent.update_graph import WARM_UP
from madviz.errors import UserError
from madviz.observation.streams import IMAGE_SIZE
from madviz.system.numbers import Count, ThreadsOrNone, Width


@dataclass(frozen=True)
class BenchUpdateConfig:
    """The timed operations, and how often each is timed."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    rounds: Count = 7
    """Timed updates of each; two more are not timed."""
    batch_size: Width = 256
    """Transitions in an update."""
    hidden_dim: Width = 1024
    """Width of the heads' hidden layers."""
    threads: ThreadsOrNone = 0
    """Threads of both; 0 leaves PyTorch's default, one per core."""
    precision: Precision = "auto"
    """Precision of our update; the naive one computes in float32."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where both compute, and where the transitions are."""


STREAMS = ("first", "third_a", "third_b")


def bench_update(config: BenchUpdateConfig) -> dict[str, Any]:
    """Medians in milliseconds, their ratio (naive by ours), our peak memory in MB; the raw times.

    The peak is the whole process's, Python and PyTorch and the batch included, while only ours has
    run: the naive learner is made afterwards. On a CUDA device it is that of PyTorch's allocator
    there. Raises UserError where that device is not there.
    """
    if config.device == "cuda" and not torch.cuda.is_available():
        raise UserError(
            "expected a CUDA device for --device cuda, found none that PyTorch can use; see "
            "`nvidia-smi`, or leave the option out"
        )
    before = torch.get_num_threads()
    torch.set_num_threads(config.threads or before)
    try:
        return _measure(config)
    finally:
        torch.set_num_threads(before)


def _measure(config: BenchUpdateConfig) -> dict[str, Any]:
    torch.manual_seed(0)
    networks = NetworkConfig(hidden_dim=config.hidden_dim)
    batch = moved(random_batch(config.batch_size, len(STREAMS), networks), config.device)
    learning = LearningConfig(precision=config.precision)
    ours = Learner(Agent(networks).to(config.device), METHODS["mad"], STREAMS, learning)
    _forget_peak()
    for _ in range(2 if config.device == "cpu" else WARM_UP + 2):
        ours.update(batch)
    peak = _peak_mb() if config.device == "cpu" else torch.cuda.max_memory_allocated() / 2**20
    naive = NaiveLearner(ours.agent, learning)
    naive.update(contiguous(batch), ours.draw(config.batch_size))
    times: dict[str, list[float]] = {"ours_ms": [], "naive_ms": []}
    for _ in range(config.rounds):
        draw = ours.draw(config.batch_size)
        times["ours_ms"].append(_milliseconds(lambda: ours.update(batch, draw)))  # noqa: B023
        plain = contiguous(batch)
        times["naive_ms"].append(_milliseconds(lambda: naive.update(plain, draw)))  # noqa: B023
    medians = {name: median(values) for name, values in times.items()}
    return {
        "ours_ms": round(medians["ours_ms"], 1),
        "naive_ms": round(medians["naive_ms"], 1),
        "ratio": round(medians["naive_ms"] / medians["ours_ms"], 2),
        "peak_mb": round(peak),
        "threads": torch.get_num_threads(),
        "device": "cpu" if config.device == "cpu" else torch.cuda.get_device_name(),
        "precision": "bfloat16" if ours.low_precision else "float32",
        "raw": {name: [round(value, 1) for value in values] for name, values in times.items()},
    }


def random_batch(size: int, streams: int, networks: NetworkConfig) -> Batch:
    """Noise for pictures and numbers, laid out as the replay buffer does: channels last."""
    rng = np.random.default_rng(0)
    shape = (size, streams, IMAGE_SIZE, IMAGE_SIZE, 3 * networks.frame_stack)

    def views() -> Tensor:
        return torch.from_numpy(rng.integers(0, 256, shape, np.uint8)).permute(0, 1, 4, 2, 3)

    def numbers(*more: int) -> Tensor:
        return torch.from_numpy(rng.standard_normal((size, *more)).astype(np.float32))

    return Batch(
        views=views(),
        next_views=views(),
        state=numbers(networks.state_dim),
        next_state=numbers(networks.state_dim),
        action=numbers(networks.action_dim).tanh(),
        reward=numbers(),
        discount=torch.full((size,), 0.99),
    )


def moved(batch: Batch, device: str) -> Batch:
    """The same batch in the memory of ``device``."""
    return Batch(**{name: tensor.to(device) for name, tensor in vars(batch).items()})


def contiguous(batch: Batch) -> Batch:
    """The same batch with channels first in memory, as the naive learner would store it."""
    tensors = {name: tensor.contiguous() for name, tensor in vars(batch).items()}
    return Batch(**tensors)


def _milliseconds(work: Any) -> float:
    """An update waits for its losses itself; what was asked of a device before is not its time."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    start = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - start)


def _forget_peak() -> None:
    """Linux can begin a new peak; elsewhere it is the process's since it started."""
    clear = HERE.with_name("clear_refs")
    if clear.exists():
        clear.write_text("5")


def _peak_mb() -> float:
    peak = kilobytes("VmHWM")
    return (peak or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 1024
