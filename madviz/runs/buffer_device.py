"""The replay buffer's frames in a GPU's memory, where batches of them are put together.

The problem: 256 transitions of three cameras show 97 MB of frames before and after. An H100 learns
from them in 5 ms, and a CPU would need longer to put them together and to send them. The idea: a
frame is sent once, when it is seen, and stacks are gathered where they are read:

    frame (H, W, C) of a time step  ->  row of the ring, 21 kB over the bus
    rows (B, F) of a batch          ->  (B, V, 3 F, H, W), channels last: 0.5 ms on an H100

150,000 time steps of three RGB streams take 9.5 GB, unpacked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from madviz.observation.streams import IMAGE_SIZE
from madviz.runs.buffer_storage import FrameStore
from madviz.types import Array


class DeviceFrames(FrameStore):
    """Every frame as it is, in the memory of ``device``."""

    def __init__(self, rows: int, channels: Sequence[int], device: str) -> None:
        """Room for ``rows`` time steps."""
        super().__init__(channels)
        size = (rows, IMAGE_SIZE, IMAGE_SIZE)
        self._rows = rows
        self._rings = [
            torch.empty((*size, count), dtype=torch.uint8, device=device) for count in channels
        ]

    def write(self, number: int, frames: Sequence[Array]) -> None:
        for ring, frame in zip(self._rings, frames, strict=True):
            ring[number % self._rows] = torch.from_numpy(np.array(frame))

    def read(self, stream: int, numbers: Iterable[int]) -> dict[int, Array]:
        wanted = list(numbers)
        rows = torch.tensor([number % self._rows for number in wanted], dtype=torch.int64)
        ring = self._rings[stream]
        return dict(zip(wanted, ring[rows.to(ring.device)].cpu().numpy(), strict=True))

    def stacks(self, histories: Sequence[Array]) -> list[Tensor]:
        return [self._stacks(history % self._rows) for history in histories]

    def _stacks(self, rows: Array) -> Tensor:
        """Those at ``rows`` (B, F)."""
        device = self._rings[0].device
        index = torch.from_numpy(rows).to(device)
        shape = (len(rows), len(self._rings), IMAGE_SIZE, IMAGE_SIZE, rows.shape[1], 3)
        out = torch.empty(shape, dtype=torch.uint8, device=device)
        for v, ring in enumerate(self._rings):
            out[:, v] = ring[index].permute(0, 2, 3, 1, 4)  # Depth is repeated three times.
        return out.flatten(4).permute(0, 1, 4, 2, 3)
