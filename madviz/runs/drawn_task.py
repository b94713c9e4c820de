"""The task of a run and how it is drawn, in a form that goes to a worker process."""

from __future__ import annotations

from dataclasses import dataclass

from madviz.envs.registry import make_env
from madviz.observation.streams import stream_frame
from madviz.subsets import camera_of, cameras_of
from madviz.types import Array, CameraSpec, Environment


@dataclass(frozen=True)
class DrawnTask:
    """A task as it is drawn, and the streams that are taken from it."""

    task: str
    render_profile: str
    cameras: tuple[CameraSpec, ...]
    """All that are drawn: those of the setting, or of the user's file."""
    streams: tuple[str, ...]
    """In the order of axis V; of all cameras or of some."""

    def build(self) -> Environment:
        """A new environment. Raises UserError as ``make_env`` does."""
        return make_env(self.task, self.render_profile, self.cameras)


def newest_frames(env: Environment, streams: tuple[str, ...]) -> list[Array]:
    """The present frame (H, W, C) uint8 of every stream; no other camera is drawn."""
    views = {camera: env.view(camera) for camera in cameras_of(streams)}
    return [stream_frame(views[camera_of(stream)], stream, env.spec) for stream in streams]
