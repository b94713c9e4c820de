"""The replay buffer: every camera frame once, stacks made when they are sampled.

A transition shows each stream's last three frames, before and after: stored as it is used, every
frame would be there six times. Here a *time step* (what was seen after a reset or a step) is one
row of a ring, and a transition is two rows that follow each other:

    row      41      42      43      44      45                row 44 starts an episode: age 0
    age       8       9      10       0       1
    stack of 43: 41 42 43     of 44: 44 44 44     of 45: 44 44 45      43 -> 44 is no transition

Memory for 500,000 transitions of three 84x84 RGB streams in episodes of 100 decisions: 505,003 rows
of 63,504 bytes, 32.1 GB, where full stacks of both sides take 190. Frames may be packed without
loss (``buffer_packed``), which takes 6 to 8 GB, or be on a disk or in a GPU's memory; the need is
said before the first step is taken, and checked again when the first frames have been packed.

Several environments that step together share a ring: a row for each of them in turn, its *lanes*.
What follows the time step i of a lane is then i + lanes.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from madviz.agent.objectives import Batch
from madviz.errors import UserError
from madviz.observation.streams import IMAGE_SIZE, channels_of
from madviz.runs import buffer_storage
from madviz.runs.buffer_device import DeviceFrames
from madviz.runs.buffer_storage import (
    EXPECTED_SHARE,
    FrameStore,
    Pack,
    PackedFrames,
    PlainFrames,
)
from madviz.system.files import replacing
from madviz.system.machine import free_memory
from madviz.types import Array


@dataclass(frozen=True)
class Stretch:
    """Consecutive time steps of B episodes: a frame stack, and L decisions after it."""

    frames: Tensor
    """(T, B, V, 3, H, W) uint8; T is the frame stack and L. Before an episode's first frame stand
    copies of it, as in a stack."""
    state: Tensor
    """(L + 1, B, S), from the newest frame of the stack on."""
    action: Tensor
    """(L, B, A)."""
    reward: Tensor
    """(L, B), for these actions."""
    follows: Tensor
    """(L, B): 1 where anything may be expected after it, else 0."""


@dataclass(frozen=True)
class BufferSpec:
    """The layout of a buffer: streams, numbers and capacity."""

    streams: tuple[str, ...]
    state_dim: int
    action_dim: int
    capacity: int
    """Transitions that are stored at least."""
    horizon: int
    """Decisions in an episode; one more row than that is needed for it."""
    frame_stack: int = 3
    packed: bool = False
    """Whether frames in memory are packed."""
    lanes: int = 1
    """Environments that write in turn."""

    @property
    def rows(self) -> int:
        """Time steps in the ring; a stack reaches ``frame_stack`` - 1 rows back.

        Every lane has room for the episode that is running: a resumed run plays it again.
        """
        in_lane = max(-(-self.capacity // self.lanes), self.horizon)
        return self.lanes * (in_lane + -(-in_lane // self.horizon) + self.frame_stack)

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of a stored frame, per stream: 3 for colour, 1 for depth."""
        return tuple(map(channels_of, self.streams))

    @property
    def bytes_per_row(self) -> int:
        """Bytes that a time step takes, or is expected to take where it is packed."""
        numbers = 4 * (self.state_dim + self.action_dim + 3) + 1
        return round(self.frame_bytes * (EXPECTED_SHARE if self.packed else 1)) + numbers

    @property
    def frame_bytes(self) -> int:
        """Bytes of a time step's frames, unpacked."""
        return IMAGE_SIZE**2 * sum(self.channels)


class ReplayBuffer:
    """See the module. ``begin`` an episode, ``add`` steps, ``sample`` batches."""

    def __init__(
        self,
        spec: BufferSpec,
        folder: Path | None = None,
        available: int | None = None,
        device: str = "cpu",
    ) -> None:
        """Frames live in memory, in files in ``folder``, or in the memory of a CUDA ``device``.

        ``available`` bytes there may be used, by default what the machine has free. Raises
        UserError, with need and have, where the buffer will not fit.
        """
        self.spec = spec
        rows = spec.rows
        self._device = device
        self._refuse_if_too_large(rows * spec.bytes_per_row, folder, available)
        self._frames = _frame_store(spec, folder, device)
        self._numbers: dict[str, Array] = {
            "state": np.zeros((rows, spec.state_dim), np.float32),
            "action": np.zeros((rows, spec.action_dim), np.float32),
            "reward": np.zeros(rows, np.float32),
            "discount": np.zeros(rows, np.float32),
            "age": np.zeros(rows, np.int32),
            "goes_on": np.zeros(rows, bool),
        }
        self._count = 0
        """Time steps ever written; number i is in row i modulo the rows."""
        self._saved = 0
        self._parts: list[str] = []

    def __len__(self) -> int:
        """Transitions that can be sampled."""
        return int(self._usable(np.arange(self._oldest, self._count)).sum())

    def begin(self, state: Array, frames: list[Array]) -> None:
        """The first time step of an episode: ``state`` (S,), a frame (H, W, C) per stream."""
        self._write(state, frames, age=0)

    def add(
        self, action: Array, reward: float, discount: float, state: Array, frames: list[Array]
    ) -> None:
        """A step: what was done at the newest time step of the lane whose turn it is, and the
        time step it led to. Raises UserError if frames turn out to pack too badly to fit."""
        row = self._row(self._count - self.spec.lanes)
        age = self.age
        self._numbers["action"][row] = action
        self._numbers["reward"][row] = reward
        self._numbers["discount"][row] = discount
        self._numbers["goes_on"][row] = True
        self._write(state, frames, age + 1)

    @property
    def age(self) -> int:
        """Steps taken in the running episode of the lane whose turn it is."""
        return int(self._numbers["age"][self._row(self._count - self.spec.lanes)])

    def newest(self) -> tuple[Tensor, Tensor]:
        """Views (L, V, C, H, W) uint8 and states (L, S) of every lane's newest time step."""
        index = np.arange(self._count - self.spec.lanes, self._count)  # (L,)
        return self._frames.stacks([self._history(index)])[0], self._column("state", index)

    def actions(self) -> Array:
        """(age, L, A): the actions of the episodes so far, with which they can be replayed."""
        lanes = self.spec.lanes
        age = self.age
        index = np.arange(self._count - (age + 1) * lanes, self._count - lanes)  # (age * L,)
        return self._numbers["action"][self._row(index)].reshape(age, lanes, self.spec.action_dim)

    def sample(self, size: int, rng: np.random.Generator) -> Batch:
        """``size`` transitions, uniformly and with replacement, from whole and running episodes."""
        return self.batch(self.draw(size, rng))

    def batch(self, index: Array) -> Batch:
        """The transitions that begin at the time steps numbered ``index`` (B,)."""
        names = ("state", "action", "reward", "discount")
        following = index + self.spec.lanes  # (B,); the lanes take turns.
        histories = [self._history(index), self._history(following)]
        views, next_views = self._frames.stacks(histories)
        return Batch(
            views=views,
            **{name: self._column(name, index) for name in names},
            next_views=next_views,
            next_state=self._column("state", following),
        )

    def stretch(self, index: Array, ahead: int) -> Stretch:
        """From the time steps numbered ``index`` (B,), ``ahead`` decisions on."""
        later = index[:, None] + self.spec.lanes * np.arange(1, ahead + 1)  # (B, ahead)
        history = np.concatenate([self._history(index), later], 1)  # (B, stack + ahead)
        shown = self._frames.stacks([history])[0]  # (B, V, 3 (stack + ahead), H, W)
        known = np.concatenate([index[:, None], later], 1).T  # (1 + ahead, B)
        done = known[:-1]
        return Stretch(
            frames=shown.unflatten(2, (-1, 3)).permute(2, 0, 1, 3, 4, 5),
            state=self._column("state", known),
            action=self._column("action", done),
            reward=self._column("reward", done),
            follows=(self._column("discount", done) > 0).float(),
        )

    def save(self, folder: Path) -> dict[str, Any]:
        """Writes what is new since the last ``save`` to ``folder``; returns what ``restore`` needs.

        The newest rows are written again next time, because their actions are not known yet.
        """
        folder.mkdir(parents=True, exist_ok=True)
        start = max(self._saved - self.spec.lanes, self._oldest, 0)
        if self._count > self._saved:
            name = f"part-{start:09d}-{self._count:09d}.npz"
            numbers = range(start, self._count)
            columns = {
                key: column[self._row(np.array(numbers))] for key, column in self._numbers.items()
            }
            for v in range(len(self.spec.streams)):
                frames = self._frames.read(v, numbers)
                pack = Pack.of(np.stack([frames[number] for number in numbers])).arrays()
                columns |= {f"{key}{v}": array for key, array in pack.items()}
            with replacing(folder / name) as part:
                np.savez(part, allow_pickle=False, **columns)
            self._parts = [p for p in self._parts if _span(p)[1] > self._oldest] + [name]
            self._saved = self._count
        return {"count": self._count, "parts": list(self._parts)}

    def restore(self, folder: Path, state: dict[str, Any]) -> None:
        """The buffer as it was saved; parts written after that are removed."""
        self._count = 0
        for name in state["parts"]:
            start, stop = _span(name)
            rows = self._row(np.arange(start, stop))
            with np.load(folder / name) as part:
                for key, column in self._numbers.items():
                    column[rows] = part[key]
                self._restore_frames(part, range(start, stop))
            self._count = stop
        self._count = self._saved = state["count"]
        self._parts = list(state["parts"])
        self.remove_other_parts(folder)

    def remove_other_parts(self, folder: Path) -> None:
        """Those that the state last saved or restored does not need. After a ``save`` the older
        state may need them until the new one is in its place."""
        for file in folder.glob("part*"):
            if file.name not in self._parts:
                file.unlink()

    def _restore_frames(self, part: Any, numbers: range) -> None:
        """Those of a part's frames that no part before it had."""
        packs = [
            Pack.from_arrays({key: part[f"{key}{v}"] for key in Pack.KEYS})
            for v in range(len(self.spec.streams))
        ]
        for number in range(max(numbers.start, self._count), numbers.stop):
            frames = [pack.frames([number - numbers.start])[0] for pack in packs]
            self._frames.write(number, frames)

    @property
    def packed_bytes_per_row(self) -> float:
        """Bytes of a time step's frames once packed; NaN before the first pack is made."""
        assert isinstance(self._frames, PackedFrames)
        size, count = self._frames.bytes_packed
        return size / count if count else float("nan")

    @property
    def _oldest(self) -> int:
        return max(self._count - self.spec.rows, 0)

    def _row(self, number: Any) -> Any:
        return number % self.spec.rows

    def _write(self, state: Array, frames: list[Array], age: int) -> None:
        row = self._row(self._count)
        self._frames.write(self._count, frames)
        self._numbers["state"][row] = state
        self._numbers["age"][row] = age
        self._numbers["goes_on"][row] = False
        self._count += 1
        if isinstance(self._frames, PackedFrames) and self._count == buffer_storage.TOGETHER:
            # With the first pack made, its size says more than the expectation did.
            self._refuse_if_too_large(round(self.packed_bytes_per_row * self.spec.rows), None, None)

    def _usable(self, index: Array) -> Array:
        """Whether a transition begins at these time steps whose whole stack is still there."""
        row = self._row(index)
        # A stack reaches no further back than its episode's first step.
        reach = np.minimum(self._numbers["age"][row], self.spec.frame_stack - 1)
        return self._numbers["goes_on"][row] & (index - reach * self.spec.lanes >= self._oldest)

    def draw(self, size: int, rng: np.random.Generator, ahead: int = 1) -> Array:
        """(size,) numbers of time steps at which a transition begins, for ``batch``, or ``ahead``
        of them in one episode, for ``stretch``. Raises ValueError where there are none."""
        drawn: list[int] = []
        every = range(self._oldest, self._count)
        while len(drawn) < size:
            index = rng.integers(every.start, every.stop, size) if every else np.arange(0)
            drawn += index[self._goes_far(index, ahead)].tolist()
            # All are looked at only where none of those drawn will do: 500,000 take 10 ms.
            if not drawn and not self._goes_far(np.arange(every.start, every.stop), ahead).any():
                raise ValueError(f"expected {ahead} transitions in a row in the buffer, found none")
        return np.array(drawn[:size])

    def _goes_far(self, index: Array, ahead: int) -> Array:
        """Whether ``ahead`` transitions follow each other from these time steps on."""
        far = self._usable(index)
        for step in range(1, ahead):
            later = index + step * self.spec.lanes
            far &= (later < self._count) & self._numbers["goes_on"][self._row(later)]
        return far

    def _column(self, name: str, index: Array) -> Tensor:
        return torch.from_numpy(self._numbers[name][self._row(index)])

    def _history(self, index: Array) -> Array:
        """(B, stack): the time steps that the stacks at ``index`` (B,) show, oldest first."""
        past = np.arange(self.spec.frame_stack)[::-1]  # (stack,)
        # At the beginning of an episode the first frame stands in for those before it.
        back = np.minimum(past, self._numbers["age"][self._row(index)][:, None])
        return index[:, None] - back * self.spec.lanes

    def _refuse_if_too_large(self, need: int, folder: Path | None, available: int | None) -> None:
        spec = self.spec
        have = _free(spec, folder, self._device) if available is None else available
        if need > have:
            fits = int(spec.capacity * have / need) // 1000 * 1000
            place = f"in {folder}"
            instead = ""
            if self._device != "cpu":
                place = "on the device"
                instead = ", or with the option buffer-on-host"
            elif folder is None:
                place = "in memory"
                instead = ", or with the buffer on disk"
            raise UserError(
                f"the replay buffer of {spec.capacity} transitions of {len(spec.streams)} streams "
                f"needs {need / 1e9:.1f} GB, found {have / 1e9:.1f} GB free {place}; free some, or "
                f"start a training with {fits} transitions or fewer{instead}"
            )


def _frame_store(spec: BufferSpec, folder: Path | None, device: str) -> FrameStore:
    if device != "cpu":
        return DeviceFrames(spec.rows, spec.channels, device)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        return PlainFrames(spec.rows, spec.channels, _files(spec, folder))
    kind = PackedFrames if spec.packed else PlainFrames
    return kind(spec.rows, spec.channels)


def _files(spec: BufferSpec, folder: Path) -> list[Path]:
    """The file on a disk for the frames of each stream."""
    return [folder / f"{stream}.frames" for stream in spec.streams]


def _span(part: str) -> tuple[int, int]:
    """The time steps in a part: from, and up to but without."""
    start, stop = part.removesuffix(".npz").split("-")[1:]
    return int(start), int(stop)


def _free(spec: BufferSpec, folder: Path | None, device: str) -> int:
    """Bytes that may be filled: of memory, here or of ``device``, or of the nearest disk, where
    frames of an earlier start are written over."""
    if device != "cpu":
        return torch.cuda.mem_get_info(device)[0]
    if folder is not None:
        old = sum(512 * f.stat().st_blocks for f in _files(spec, folder) if f.exists())
        while not folder.exists():
            folder = folder.absolute().parent
        disk = os.statvfs(folder)
        return disk.f_bavail * disk.f_frsize + old
    return free_memory()
