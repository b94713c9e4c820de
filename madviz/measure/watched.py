"""An episode with what it looked like: pictures, actions, and its outcome.

Most policies repeat themselves, so an episode is watched when a page needs it: it is played again.
A policy that draws random numbers does not, so its episodes are kept while they are counted: a job
names a folder for that (``Job.kept``), and ``kept`` reads what it has of an episode.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np

from madviz.errors import UserError
from madviz.measure.episodes import Finished, Job, Runner
from madviz.observation.streams import StreamStack
from madviz.subsets import camera_of, cameras_of
from madviz.system.files import write_bytes
from madviz.system.mp4 import REPEATABLE, Mp4, decoded
from madviz.types import Array, Encoded, Environment

SIDE = 168
"""Pixels of a camera in a film."""
GAP = 4
FPS = 10
RATE = 30
"""x264's constant rate factor: greater is smaller."""
_KEPT_RATE = 26
"""The factor of an episode that is kept, which is encoded once more for a page."""
_DIM = 0.3
"""Brightness of a camera that is dropped: the policy does not get its picture."""


@dataclass
class WatchedEpisode:
    """An episode with pictures."""

    pictures: list[Array] = field(default_factory=list)
    """One for each decision, (SIDE, W, 3): all cameras side by side."""
    actions: list[Array] = field(default_factory=list)
    """(A,) each."""
    looks: list[tuple[Array, Array]] = field(default_factory=list)
    """The policy's input at each decision: views (V, C, H, W) and state (S,); where they are
    asked for."""
    success: bool = False


def watched(
    job: Job,
    runner: Runner,
    looks: bool = False,
    shown: Callable[[Array], None] | None = None,
) -> tuple[WatchedEpisode, Finished]:
    """Plays the episode of ``job`` and watches it, with its ``looks`` if they are asked for.
    Pictures go to ``shown``, by default into the episode."""
    episode = WatchedEpisode()
    show = shown or episode.pictures.append
    _, policy = runner.opened(job)
    streams = policy.spec.streams

    def watch(env: Environment, stack: StreamStack, encoded: Encoded, action: Array) -> None:
        tiles = []
        present = job.condition.at(len(episode.actions)).ablation(streams).present(streams)
        for camera in cameras_of(streams):
            stream = next(one for one in streams if camera_of(one) == camera)
            picture = stack.newest[stream]  # (H, W, C)
            if camera not in present:
                picture = (_DIM * env.view(camera).rgb).astype(np.uint8)
            elif picture.shape[2] == 1:
                picture = picture.repeat(3, axis=2)
            picture = cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_LINEAR)
            tiles += [picture, np.full((SIDE, GAP, 3), 40, np.uint8)]
        show(np.concatenate(tiles[:-1], axis=1))
        episode.actions.append(np.asarray(action, np.float32))
        if looks:
            episode.looks.append((stack.views, encoded.state))

    finished = runner.run(job, watch)
    episode.success = finished[0].success
    return episode, finished


def carry_out(job: Job, runner: Runner) -> Finished:
    """Plays the episode of ``job``, and keeps it in the folder that the job names, if any. Where
    that cannot be written, the episode counts all the same."""
    if not job.kept:
        return runner.run(job)
    file = _file(job)
    with suppress(OSError):
        file.unlink(missing_ok=True)  # A stopped run may have kept one that was not counted.
    film = BytesIO()
    written = Mp4(film, FPS, _KEPT_RATE, REPEATABLE)
    episode, finished = watched(job, runner, shown=written.add)
    written.close()
    content = BytesIO()
    np.savez(
        content,
        film=np.frombuffer(film.getvalue(), np.uint8),
        actions=np.stack(episode.actions),
        success=np.array(episode.success),
    )
    with suppress(OSError, UserError):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(file, content.getvalue())
    return finished


def kept(job: Job) -> WatchedEpisode | None:
    """The episode of ``job`` as it was kept; None where it was not, or its file is broken."""
    try:
        with np.load(_file(job), allow_pickle=False) as found:
            actions = list(found["actions"])
            film = BytesIO(found["film"].tobytes())
            pictures = decoded(film, len(actions))
            return WatchedEpisode(pictures, actions, [], bool(found["success"]))
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None


def _file(job: Job) -> Path:
    condition = f"{job.condition.subset} {job.condition.key()}"
    return Path(job.kept) / f"{sha256(condition.encode()).hexdigest()[:12]}-{job.seed}.npz"
