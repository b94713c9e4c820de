"""From what cameras see to what a policy gets: modality, depth code, occlusion, frame stack.

    View (rgb, metres) -> frame (H, W, C) uint8 -> occlusion -> the last K frames -> (V, 3K, H, W)

Depth in metres is clipped to the camera's ``depth_range`` and coded 0..255, so absolute distance
survives (a per-frame min-max scaling would lose it); a policy gets it as three equal channels and
can share one CNN with colour. With a range of 0 to 2 m, 0.5 m is coded 64 (8 mm a step).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from madviz.errors import UserError
from madviz.observation.ablation import LATEST, Ablation, noise_generator
from madviz.subsets import camera_of, modality_of
from madviz.system.depth import depth_code
from madviz.types import Array, EnvSpec, View

IMAGE_SIZE = 84
"""Rows and columns a policy gets unless it says otherwise; a camera drawn at another size is
resized."""


MeanPictures = Mapping[str, Array]
"""By stream, (H, W, C) uint8: what its camera sees on average."""


def no_mean_pictures() -> MeanPictures:
    """Raises UserError: nobody knows the mean pictures here."""
    raise UserError("expected mean pictures of the cameras, found none here; choose black or noise")


def stream_frame(view: View | None, stream: str, env: EnvSpec, size: int = IMAGE_SIZE) -> Array:
    """The part of its camera's view that ``stream`` takes: (H, W, 3) colour or (H, W, 1) coded
    depth, H and W being ``size``. Raises UserError for a view that a task may not give."""
    if view is None:
        raise UserError(
            f"expected a View of {camera_of(stream)}, found None; let {env.task} draw it"
        )
    if modality_of(stream) == "depth":
        frame = depth_code(view.depth, env.camera(camera_of(stream)).depth_range)
    else:
        frame = np.asarray(view.rgb)
        if frame.dtype != np.uint8 or frame.shape[2:] != (3,):
            move = "convert it, 0 to 255" if frame.dtype != np.uint8 else "give three channels"
            raise UserError(
                f"expected rgb of {camera_of(stream)} as (H, W, 3) uint8, found {frame.shape} "
                f"{frame.dtype}; {move} in {env.task}"
            )
    if frame.shape[0] != frame.shape[1]:
        raise UserError(
            f"expected a square picture of {camera_of(stream)}, found {frame.shape[0]} x "
            f"{frame.shape[1]}; let {env.task} add bars or crop it"
        )
    if frame.shape[0] != size:
        frame = cv2.resize(frame, (size, size), interpolation=cv2.INTER_AREA)
        frame = frame.reshape(size, size, -1)
    return frame


def channels_of(stream: str) -> int:
    """C of a stream's frame: 3 for colour, 1 for depth."""
    return 1 if modality_of(stream) == "depth" else 3


def to_channels(frame: Array) -> Array:
    """(H, W, C) -> (3, H, W); one channel of depth becomes three equal ones."""
    return np.ascontiguousarray(np.broadcast_to(frame, (*frame.shape[:2], 3)).transpose(2, 0, 1))


@dataclass
class StreamStack:
    """The last ``length`` frames of every stream, occlusions applied as they arrive.

    An occlusion that begins now spoils one frame of the stack now and all of them after ``length``
    frames, as a failing camera would. ``replace_last`` re-applies a changed ablation to the newest
    frames only: it is what makes a toggle visible before the next step.
    """

    env: EnvSpec
    streams: tuple[str, ...]
    length: int = 3
    size: int = IMAGE_SIZE
    """H and W."""
    means: Callable[[], MeanPictures] = no_mean_pictures
    """Asked when a camera sends its mean picture."""
    _frames: list[dict[str, Array]] = field(default_factory=list)
    """The newest ``length`` + 1 steps, frames (H, W, C) by stream, as they arrived; ``freeze``
    holds on to the extra one."""
    _seen: list[dict[str, Array]] = field(default_factory=list)
    """The same frames before an occlusion was applied, newest last; as far back as a delay goes."""
    _noise_key: tuple[int, int] = (0, 0)
    """Seed and step: noise is the same however often a frame arrives again."""

    def push(self, views: dict[str, View], ablation: Ablation, seed: int, step: int) -> None:
        """Takes the views of one step. Cameras absent from ``views`` arrive black; at ``step`` 0
        the stack is filled with the first frame."""
        seen = {}
        for stream in self.streams:
            camera = camera_of(stream)
            black = np.zeros((self.size, self.size, channels_of(stream)), np.uint8)
            seen[stream] = black
            if camera in views:
                seen[stream] = stream_frame(views[camera], stream, self.env, self.size)
        if step == 0:
            self._frames = []
            self._seen = []
        self._seen = [*self._seen, seen][-LATEST - 1 :]
        self._noise_key = (seed, step)
        if self._frames:
            arrived = self._arrived(self._frames[-1], ablation)
            self._frames = [*self._frames, arrived][-self.length - 1 :]
        else:
            # An episode has no past yet: its first frame stands for all of it.
            self._frames = [self._arrived(None, ablation)] * (self.length + 1)

    def replace_last(self, ablation: Ablation) -> None:
        """Lets the newest frames arrive again, under another ablation."""
        first = self._noise_key[1] == 0
        if first:
            self._frames = [self._arrived(None, ablation)] * (self.length + 1)
        else:
            self._frames = [*self._frames[:-1], self._arrived(self._frames[-2], ablation)]

    def replace_view(self, camera: str, view: View) -> None:
        """Exchanges what ``camera`` saw last, as if it had always been so; ``replace_last`` lets it
        arrive."""
        streams = [stream for stream in self.streams if camera_of(stream) == camera]
        fresh = {stream: stream_frame(view, stream, self.env, self.size) for stream in streams}
        self._seen = [*self._seen[:-1], {**self._seen[-1], **fresh}]

    def snapshot(self) -> tuple:
        """The state that ``restore`` returns to; pictures are shared, not copied."""
        return tuple(self._frames), tuple(self._seen), self._noise_key

    def restore(self, saved: tuple) -> None:
        frames, seen, self._noise_key = saved
        self._frames = list(frames)
        self._seen = list(seen)

    @property
    def newest(self) -> dict[str, Array]:
        """The frames (H, W, C) that arrived last, by stream."""
        return self._frames[-1]

    @property
    def views(self) -> Array:
        """(V, 3 x length, H, W) uint8, oldest frame first."""
        stacks = [
            np.concatenate([to_channels(frames[stream]) for frames in self._frames[1:]])
            for stream in self.streams
        ]  # V of (3 x length, H, W); the oldest of the length + 1 steps is left out
        return np.stack(stacks)

    def _arrived(self, before: dict[str, Array] | None, ablation: Ablation) -> dict[str, Array]:
        """The newest frames after their occlusions. ``before`` arrived the step before."""
        arrived = {}
        for stream in self.streams:
            occlusion = ablation.camera(camera_of(stream)).occlusion
            # A delayed camera sends what it saw some steps ago; at first, its oldest frame.
            steps_back = min(occlusion.late, len(self._seen) - 1)
            frame = self._seen[-1 - steps_back][stream]  # (H, W, C)
            if occlusion.kind == "mean":
                frame = self.means()[stream]
            # A lost frame is lost in colour and depth together; grains of noise are not shared.
            drawn_for = camera_of(stream) if occlusion.kind == "dropout" else stream
            rng = noise_generator(*self._noise_key, drawn_for)
            arrived[stream] = occlusion.apply(frame, before[stream] if before else None, rng)
        return arrived
