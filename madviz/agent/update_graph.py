"""An update as one CUDA graph, and the randomness that goes into it.

The problem: an update of 256 transitions is a thousand small kernels, and a GPU that needs 5
microseconds for one waits for Python, which needs more to ask for it. The idea: CUDA can record
them once and repeat them in one go. What is recorded reads and writes fixed places in memory, so a
batch and its draws are copied there first:

    warm-up     3 updates, kernel by kernel: they choose algorithms and make the optimisers' state
    recording   1 time, which computes nothing
    from then   copy batch and draws to their places -> repeat

On an H100 an update of 256 transitions of three cameras takes 5.2 ms so, and 13.8 kernel by kernel.
A batch of another size is not what was recorded, and is worked off kernel by kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from madviz.agent.merges.base import Noise
from madviz.agent.objectives import Batch
from madviz.types import Array

WARM_UP = 3
"""Updates before the recording; fewer would leave allocations to it."""


@dataclass(frozen=True)
class Draw:
    """All the randomness of one update."""

    shifts: Array
    """(2, B, V, 2) pixels by which observations, then next observations, are moved; in a recorded
    update a tensor."""
    target_noise: Tensor
    """(R, B, A) standard normal, for a'."""
    actor_noise: Tensor
    """(N, B, A) standard normal, for the rows' actions."""
    merge_noise: tuple[Noise, Noise] = (None, None)
    """The merge's, for observations and for next observations."""
    own_loss: tuple[Array, int] | None = None
    """For a merge's own loss: fresh shifts, (2, B, V, 2) as above, and a view."""


class GraphedUpdate:
    """Calls ``update``, and from the fourth time on repeats what it did."""

    def __init__(self, update: Callable[[Batch, Draw], Tensor], device: torch.device) -> None:
        """``update`` must not wait for the device, nor read anything but its arguments and what
        it changes itself."""
        self._update = update
        self._device = device
        torch.backends.cudnn.benchmark = True  # Sizes never change: the fastest is found once.
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, batch: Batch, draw: Draw) -> Tensor:
        """The losses of one update; they are overwritten by the next one."""
        self._calls += 1
        if self._calls <= WARM_UP:
            return self._aside(batch, draw)
        if self._graph is None:
            self._record(batch, draw)
        inputs = list(_tensors(batch, draw))
        if [each.shape for each in inputs] != [place.shape for place in self._places]:
            return self._aside(batch, draw)
        for place, new in zip(self._places, inputs, strict=True):
            place.copy_(new, non_blocking=True)
        assert self._graph is not None
        self._graph.replay()
        return self._losses

    def _aside(self, batch: Batch, draw: Draw) -> Tensor:
        """On a stream of its own, as recording will be: autograd stays on the one it has met."""
        present = torch.cuda.current_stream()
        aside = torch.cuda.Stream()
        aside.wait_stream(present)
        with torch.cuda.stream(aside):
            losses = self._update(batch, draw)
        present.wait_stream(aside)
        return losses

    def _record(self, batch: Batch, draw: Draw) -> None:
        self._places = [each.to(self._device).clone() for each in _tensors(batch, draw)]
        fixed = _with_tensors(batch, draw, iter(self._places))
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._losses = self._update(*fixed)


def _tensors(batch: Batch, draw: Draw) -> Iterator[Tensor]:
    """All that changes from update to update, in the order of ``_with_tensors``."""
    yield from vars(batch).values()
    yield torch.as_tensor(draw.shifts)
    yield draw.target_noise
    yield draw.actor_noise
    yield from (noise for noise in draw.merge_noise if noise is not None)


def _with_tensors(batch: Batch, draw: Draw, tensors: Iterator[Tensor]) -> tuple[Batch, Draw]:
    """``batch`` and ``draw`` with ``tensors`` in place of their own."""
    fixed = Batch(**{name: next(tensors) for name in vars(batch)})
    names = ("shifts", "target_noise", "actor_noise")
    drawn: dict[str, Any] = {name: next(tensors) for name in names}
    noise = tuple(None if each is None else next(tensors) for each in draw.merge_noise)
    return fixed, replace(draw, **drawn, merge_noise=noise)
