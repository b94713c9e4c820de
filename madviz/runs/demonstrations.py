"""Episodes that an expert labels: driven by the expert, by a student, or by a mix of both.

A student that only saw the expert's own states drifts into states nobody showed it. So after the
first demonstrations the student drives, seeing the cameras of one of its trained subsets, and the
expert says at every state what it would have done (dataset aggregation). Whoever drives, a fifth of
the actions is replaced by a random one, so that recoveries are in the data; or a normal noise is
added that changes slowly, which is gentler: where an action asks for 10 cm, a random one undoes
what was lined up, and a spread of 0.2 is 2 cm.

An episode of 100 decisions and three RGB streams is 6.4 MB: every frame is stored once, and stacks
are formed when a batch is drawn.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from madviz.envs.checks import check_state, expert_action
from madviz.errors import UserError
from madviz.measure.episodes import one_thread
from madviz.observation.ablation import Ablation
from madviz.observation.streams import StreamStack, stream_frame
from madviz.runs.drawn_task import DrawnTask
from madviz.subsets import camera_of, cameras_of
from madviz.system.files import replacing
from madviz.system.processes import set_up_worker_of_training
from madviz.types import Array, Environment, KnowsPlaces, Policy

COLUMNS = ("states", "actions", "labels", "rewards", "places")
"""The columns of an episode, a row for each decision, besides its frames."""
FRAMES = "frames."
"""The beginning of a stream's name among an episode's columns."""
LASTING = 0.8
"""Share of the added noise that stays from one decision to the next: half of it for 3 decisions."""

USUAL = 512
"""Decisions whose pictures show what is usual."""


@dataclass(frozen=True)
class Episode:
    """One labelled episode of T decisions."""

    frames: dict[str, Array]
    """Stream -> (T, C, H, W) uint8, C = 3 for colour and 1 for depth."""
    states: Array
    """(T, S) float32."""
    actions: Array
    """(T, A) float32, what was done."""
    labels: Array
    """(T, A) float32, what the expert would have done."""
    rewards: Array
    """(T,) float32."""
    places: Array
    """(T, 3 P) float32, where objects and goal were; P = 0 where the environment does not say."""
    success: bool
    """At the last step."""

    def rows(self) -> dict[str, Array]:
        """Everything that has T rows, by name: ``frames.first`` and the others, and ``COLUMNS``."""
        frames = {f"{FRAMES}{stream}": frames for stream, frames in self.frames.items()}
        return frames | {name: getattr(self, name) for name in COLUMNS}

    def save(self, file: Path) -> None:
        """One uncompressed archive, whole or not at all."""
        with replacing(file) as part:
            np.savez(part, allow_pickle=False, **self.rows(), success=self.success)

    @staticmethod
    def load(file: Path) -> Episode:
        with np.load(file, allow_pickle=False) as archive:
            rows = dict(archive)
        success = bool(rows.pop("success"))
        columns = {name: rows.pop(name) for name in COLUMNS}
        frames = {name.removeprefix(FRAMES): row for name, row in rows.items()}
        return Episode(frames, **columns, success=success)


@dataclass(frozen=True)
class Driver:
    """The driver of an episode: the expert with probability ``expert_share`` at every step, else
    the student."""

    expert_share: float = 1.0
    noise_share: float = 0.2
    """Probability that an action is replaced by a uniformly random one."""
    student: Policy | None = None
    mask: Array | None = None
    """(V,) the streams the student sees."""
    noise_spread: float = 0.0
    """Spread of a normal noise that is added to every action and changes slowly."""


def record_episode(
    env: Environment, streams: tuple[str, ...], driver: Driver, seed: int
) -> Episode:
    """Plays one episode; the same arguments give the same episode to the bit. Raises UserError for
    one that ends early: rows of all episodes stand side by side."""
    rng = np.random.default_rng([seed, 7])
    stack = StreamStack(env.spec, streams)
    cameras = cameras_of(streams)
    rows: dict[str, list] = {k: [] for k in COLUMNS}
    pushed = slow_noise(rng, driver.noise_spread, env.spec.action_dim)
    frames: dict[str, list[Array]] = {stream: [] for stream in streams}
    now = env.reset(seed)
    for step in range(env.spec.horizon):
        check_state(now.state, env.spec)
        views = {camera: env.view(camera) for camera in cameras}
        for stream in streams:
            frame = stream_frame(views[camera_of(stream)], stream, env.spec)
            frames[stream].append(np.ascontiguousarray(frame.transpose(2, 0, 1)))
        action = label = expert_action(env)
        student_drives = rng.random() >= driver.expert_share
        if driver.student is not None:
            stack.push(views, Ablation(), seed, step)
            if student_drives and driver.mask is not None:
                encoded = driver.student.encode(stack.views, now.state)
                action = driver.student.read(encoded, driver.mask[None]).action[0]
        if rng.random() < driver.noise_share:
            action = rng.uniform(-1, 1, len(label)).astype(np.float32)
        if driver.noise_spread:
            action = np.clip(action + next(pushed), -1, 1).astype(np.float32)
        rows["states"].append(now.state)
        rows["places"].append(env.places() if isinstance(env, KnowsPlaces) else ())
        now = env.step(action)
        for key, value in (("actions", action), ("labels", label), ("rewards", now.reward)):
            rows[key].append(value)
        if now.last and step + 1 < env.spec.horizon:
            raise UserError(
                f"expected episodes of {env.spec.task} to have all {env.spec.horizon} decisions, "
                f"found one that ended after {step + 1}; only --recipe paper trains on such a task"
            )
    arrays = {key: np.asarray(value, np.float32) for key, value in rows.items()}
    stacked = {s: np.stack(f) for s, f in frames.items()}
    return Episode(stacked, **arrays, success=bool(now.success))


def slow_noise(rng: np.random.Generator, std: float, size: int) -> Iterator[Array]:
    """Normal numbers (size,) of the given standard deviation, each set like the one before it."""
    now = rng.normal(size=size)
    while True:
        yield std * now
        now = LASTING * now + np.sqrt(1 - LASTING**2) * rng.normal(size=size)


class Dataset:
    """All episodes in flat arrays; index i is one decision, whose stack ends at i."""

    def __init__(self, streams: tuple[str, ...], capacity: int, horizon: int) -> None:
        self.streams = streams
        self.horizon = horizon
        self.episodes = 0
        self._capacity = capacity
        self._rows: dict[str, Array] = {}
        """By name, as ``Episode.rows``."""

    def __len__(self) -> int:
        return self.episodes * self.horizon

    def add(self, episode: Episode) -> None:
        """Copies an episode in, without streams that are not asked for. The arrays are allocated at
        the first one; untouched pages of them cost no memory."""
        size = self._capacity * self.horizon
        read = {*COLUMNS, *(f"{FRAMES}{stream}" for stream in self.streams)}
        for name, rows in episode.rows().items():
            if name not in read:
                continue
            if name not in self._rows:
                self._rows[name] = np.empty((size, *rows.shape[1:]), rows.dtype)
            self._rows[name][len(self) : len(self) + self.horizon] = rows
        self.episodes += 1

    def views(self, index: Array, length: int = 3) -> Tensor:
        """(B,) decisions -> (B, V, 3 x length, H, W) uint8; stacks never reach over a start."""
        start = index - index % self.horizon  # (B,)
        back = index[:, None] - np.arange(length - 1, -1, -1)  # (B, length), oldest first
        back = np.maximum(back, start[:, None])
        stacks = []
        for stream in self.streams:
            frames = self._rows[f"{FRAMES}{stream}"][back]  # (B, length, C, H, W)
            if frames.shape[2] == 1:
                frames = np.broadcast_to(frames, (*frames.shape[:2], 3, *frames.shape[3:]))
            stacks.append(frames.reshape(len(index), 3 * length, *frames.shape[3:]))
        return torch.from_numpy(np.stack(stacks, 1))

    def following(self, index: Array) -> Array:
        """(B,) the decision after each; the last one of an episode has none and is its own."""
        return np.minimum(index + 1, index - index % self.horizon + self.horizon - 1)

    def usual_views(self, index: Array | None = None) -> Tensor:
        """(B, V, 3, H, W) of about ``USUAL`` evenly spaced decisions of those in ``index``, or of
        all: what is usual there."""
        index = np.arange(len(self)) if index is None else index
        return self.views(index[:: max(1, len(index) // USUAL)], 1)

    def column(self, name: str, index: Array) -> Tensor:
        """Rows of one of ``COLUMNS``."""
        return torch.from_numpy(self._rows[name][index])


@lru_cache(maxsize=1)
def _environment(drawn_task: DrawnTask) -> Environment:
    """A worker process keeps its environment between episodes."""
    return drawn_task.build()


def _record(drawn_task: DrawnTask, driver: Driver, seed: int) -> Episode:
    """``record_episode`` for a process pool; PyTorch on one thread, so that results repeat."""
    with one_thread():
        return record_episode(_environment(drawn_task), drawn_task.streams, driver, seed)


class Recorder:
    """Records a round's episodes in worker processes while the caller does something else."""

    def __init__(self, drawn_task: DrawnTask, workers: int) -> None:
        self._task = drawn_task
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(workers, context, set_up_worker_of_training)

    def start(self, plan: list[tuple[Driver, int]]) -> list[Future[Episode]]:
        return [self._pool.submit(_record, self._task, d, s) for d, s in plan]

    @staticmethod
    def finish(recording: list[Future[Episode]]) -> list[Episode]:
        """Waits for the episodes. Raises UserError if a recording process was killed."""
        try:
            return [future.result() for future in recording]
        except BrokenProcessPool as error:
            raise UserError(
                "expected the recording process to live, found it killed (out of memory?); "
                "free memory; a run that was saved before goes on with --resume"
            ) from error

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
