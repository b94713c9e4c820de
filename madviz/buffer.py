"""The replay buffer: every camera frame once, stacks made when they are sampled.

A transition shows each stream's last three frames, before and after: stored as it is used, every
frame would be there six times. Here an *instant* (what was seen after a reset or a step) is one row
of a ring, and a transition is two rows that follow each other:

    row      41      42      43      44      45                row 44 starts an episode: age 0
    age       8       9      10       0       1
    stack of 43: 41 42 43     of 44: 44 44 44     of 45: 44 44 45      43 -> 44 is no transition

Memory for 500,000 transitions of three 84x84 RGB streams in episodes of 100 decisions: 505,003 rows
of 63,504 bytes, 32.1 GB, where full stacks of both sides take 190. It is asked for
before the first step is taken, and may be on a disk.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from madviz.agent.objectives import Batch
from madviz.streams import IMAGE_SIZE
from madviz.subsets import modality_of
from madviz.types import Array, UserError


@dataclass(frozen=True)
class BufferSpec:
    """What is stored, and how much of it."""

    streams: tuple[str, ...]
    state_dim: int
    action_dim: int
    capacity: int
    """Transitions that are kept at least."""
    horizon: int
    """Decisions in an episode; one more row than that is needed for it."""
    frame_stack: int = 3

    @property
    def rows(self) -> int:
        """Instants in the ring; a stack reaches ``frame_stack`` - 1 rows back."""
        return self.capacity + -(-self.capacity // self.horizon) + self.frame_stack

    @property
    def channels(self) -> tuple[int, ...]:
        """Of a stored frame, per stream: 3 for colour, 1 for depth."""
        return tuple(1 if modality_of(stream) == "depth" else 3 for stream in self.streams)

    @property
    def bytes_per_row(self) -> int:
        numbers = 4 * (self.state_dim + self.action_dim + 3) + 1
        return IMAGE_SIZE**2 * sum(self.channels) + numbers


class ReplayBuffer:
    """See the module. ``begin`` an episode, ``add`` steps, ``sample`` batches."""

    def __init__(
        self, spec: BufferSpec, folder: Path | None = None, available: int | None = None
    ) -> None:
        """Frames live in memory, or in files in ``folder``.

        ``available`` bytes there may be used, by default what the machine has free. Raises
        UserError, with need and have, where the buffer will not fit.
        """
        self.spec = spec
        self._refuse_if_too_large(folder, available)
        rows, size = spec.rows, IMAGE_SIZE
        shapes = [(rows, size, size, channels) for channels in spec.channels]
        if folder is None:
            self._frames = [np.empty(shape, np.uint8) for shape in shapes]
        else:
            folder.mkdir(parents=True, exist_ok=True)
            files = [folder / f"{stream}.frames" for stream in spec.streams]
            self._frames = [
                np.memmap(file, np.uint8, "w+", shape=shape)
                for file, shape in zip(files, shapes, strict=True)
            ]
        self._numbers: dict[str, Array] = {
            "state": np.zeros((rows, spec.state_dim), np.float32),
            "action": np.zeros((rows, spec.action_dim), np.float32),
            "reward": np.zeros(rows, np.float32),
            "discount": np.zeros(rows, np.float32),
            "age": np.zeros(rows, np.int32),
            "goes_on": np.zeros(rows, bool),
        }
        self._count = 0
        """Instants ever written; number i is in row i modulo the rows."""
        self._saved = 0
        self._parts: list[str] = []

    def __len__(self) -> int:
        """Transitions that can be sampled."""
        return int(self._usable(np.arange(self._oldest, self._count)).sum())

    def begin(self, state: Array, frames: list[Array]) -> None:
        """The first instant of an episode: ``state`` (S,), a frame (H, W, C) per stream."""
        self._write(state, frames, age=0)

    def add(
        self, action: Array, reward: float, discount: float, state: Array, frames: list[Array]
    ) -> None:
        """A step: what was done at the newest instant, and the instant it led to."""
        row, age = self._row(self._count - 1), self.age
        self._numbers["action"][row] = action
        self._numbers["reward"][row] = reward
        self._numbers["discount"][row] = discount
        self._numbers["goes_on"][row] = True
        self._write(state, frames, age + 1)

    @property
    def age(self) -> int:
        """Steps taken in the episode so far."""
        return int(self._numbers["age"][self._row(self._count - 1)])

    def newest(self) -> tuple[Tensor, Tensor]:
        """Views (V, C, H, W) uint8 and state (S,) of the newest instant."""
        index = np.array([self._count - 1])
        return self._stacks(index)[0], self._column("state", index)[0]

    def actions(self) -> Array:
        """(age, A): the actions of the episode so far, with which it can be replayed."""
        return self._numbers["action"][
            self._row(np.arange(self._count - 1 - self.age, self._count - 1))
        ]

    def sample(self, size: int, rng: np.random.Generator) -> Batch:
        """``size`` transitions, uniformly and with replacement, from whole and running episodes."""
        return self.batch(self._draw(size, rng))

    def batch(self, index: Array) -> Batch:
        """The transitions that begin at the instants numbered ``index`` (B,)."""
        names = ("state", "action", "reward", "discount")
        return Batch(
            views=self._stacks(index),
            **{name: self._column(name, index) for name in names},
            next_views=self._stacks(index + 1),
            next_state=self._column("state", index + 1),
        )

    def save(self, folder: Path) -> dict[str, Any]:
        """Writes what is new since the last ``save`` to ``folder``; returns what ``restore`` needs.

        The newest row is written again next time, because its action is not known yet.
        """
        folder.mkdir(parents=True, exist_ok=True)
        start = max(self._saved - 1, self._oldest, 0)
        if self._count > self._saved:
            name = f"part-{start:09d}-{self._count:09d}.npz"
            rows = self._row(np.arange(start, self._count))
            frames = {f"frames{v}": frame[rows] for v, frame in enumerate(self._frames)}
            numbers = {key: column[rows] for key, column in self._numbers.items()}
            with (folder / "part.tmp").open("wb") as file:
                np.savez_compressed(file, allow_pickle=False, **frames, **numbers)
            os.replace(folder / "part.tmp", folder / name)
            self._parts = [p for p in self._parts if _span(p)[1] > self._oldest] + [name]
            self._saved = self._count
        return {"count": self._count, "parts": list(self._parts)}

    def restore(self, folder: Path, state: dict[str, Any]) -> None:
        """The buffer as it was saved; parts written after that are removed."""
        for name in state["parts"]:
            start, stop = _span(name)
            rows = self._row(np.arange(start, stop))
            with np.load(folder / name) as part:
                for v, frames in enumerate(self._frames):
                    frames[rows] = part[f"frames{v}"]
                for key, column in self._numbers.items():
                    column[rows] = part[key]
        for file in folder.glob("part*"):
            if file.name not in state["parts"]:
                file.unlink()
        self._count = self._saved = state["count"]
        self._parts = list(state["parts"])

    @property
    def _oldest(self) -> int:
        return max(self._count - self.spec.rows, 0)

    def _row(self, number: Any) -> Any:
        return number % self.spec.rows

    def _write(self, state: Array, frames: list[Array], age: int) -> None:
        row = self._row(self._count)
        for store, frame in zip(self._frames, frames, strict=True):
            store[row] = frame
        self._numbers["state"][row] = state
        self._numbers["age"][row] = age
        self._numbers["goes_on"][row] = False
        self._count += 1

    def _usable(self, index: Array) -> Array:
        """Whether a transition begins at these instants whose whole stack is still there."""
        row = self._row(index)
        reach = np.minimum(self._numbers["age"][row], self.spec.frame_stack - 1)
        return self._numbers["goes_on"][row] & (index - reach >= self._oldest)

    def _draw(self, size: int, rng: np.random.Generator) -> Array:
        found: list[int] = []
        if not len(self):
            raise ValueError("expected at least one transition in the buffer, found none")
        while len(found) < size:
            index = rng.integers(self._oldest, self._count, size)
            found += index[self._usable(index)].tolist()
        return np.array(found[:size])

    def _column(self, name: str, index: Array) -> Tensor:
        return torch.from_numpy(self._numbers[name][self._row(index)])

    def _stacks(self, index: Array) -> Tensor:
        """(B, V, 3 x stack, H, W) uint8, channels last in memory: what the encoder wants."""
        stack, size = self.spec.frame_stack, IMAGE_SIZE
        back = np.minimum(np.arange(stack)[::-1, None], self._numbers["age"][self._row(index)])
        rows = self._row(index - back).T.tolist()
        out = np.empty((len(index), len(self._frames), size, size, 3 * stack), np.uint8)
        for v, frames in enumerate(self._frames):
            repeat = 3 // frames.shape[-1]
            for views, history in zip(out, rows, strict=True):
                cv2.merge([frames[row] for row in history for _ in range(repeat)], views[v])
        return torch.from_numpy(out).permute(0, 1, 4, 2, 3)

    def _refuse_if_too_large(self, folder: Path | None, available: int | None) -> None:
        spec = self.spec
        need = spec.rows * spec.bytes_per_row
        have = _free(folder) if available is None else available
        if need > have:
            fits = int(spec.capacity * have / need) // 1000 * 1000
            raise UserError(
                f"the replay buffer of {spec.capacity} transitions of {len(spec.streams)} streams "
                f"needs {need / 1e9:.1f} GB, found {have / 1e9:.1f} GB free "
                f"{'in memory' if folder is None else f'in {folder}'}; "
                f"ask for {fits} transitions or fewer"
                + (", or keep it on disk" if folder is None else "")
            )


def _span(part: str) -> tuple[int, int]:
    """The instants in a part: from, and up to but without."""
    start, stop = part.removesuffix(".npz").split("-")[1:]
    return int(start), int(stop)


def _free(folder: Path | None) -> int:
    """Bytes that may be filled: of the nearest disk, or of memory."""
    if folder is not None:
        while not folder.exists():
            folder = folder.absolute().parent
        disk = os.statvfs(folder)
        return disk.f_bavail * disk.f_frsize
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        fields = dict(line.split(":") for line in meminfo.read_text().splitlines())
        return int(fields["MemAvailable"].split()[0]) * 1024
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
