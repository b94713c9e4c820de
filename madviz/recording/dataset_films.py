"""The colour pictures of a LeRobot dataset as films: one of each camera, with all episodes.

An episode stands between two times of each film; meta/episodes has them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from madviz.errors import UserError
from madviz.system.mp4 import SEEKABLE, Mp4
from madviz.types import Array

FILMS = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


class DatasetFilms:
    """See the module. ``close`` completes the files."""

    def __init__(self, folder: Path, fps: float) -> None:
        self._folder = folder
        self._fps = fps
        self._films: dict[str, Mp4] = {}
        self._lengths: dict[str, int] = {}

    def add(self, key: str, frames: Sequence[Array]) -> dict[str, float]:
        """Appends an episode's pictures (H, W, 3) uint8 of the feature ``key``; the columns of the
        episode's row. Raises UserError for sides that H.264 cannot have."""
        if key not in self._films:
            height, width = frames[0].shape[:2]
            if height % 2 or width % 2:
                raise UserError(
                    f"--video: expected pictures with even sides, found {height} x {width} in "
                    f"{key}; leave --video out, or give the camera another size"
                )
            path = self._folder / FILMS.format(video_key=key, chunk_index=0, file_index=0)
            path.parent.mkdir(parents=True)
            self._films[key] = Mp4(path, self._fps, options=SEEKABLE)
        first = self._lengths.get(key, 0)
        for frame in frames:
            self._films[key].add(frame)
        self._lengths[key] = first + len(frames)
        return {
            f"videos/{key}/chunk_index": 0,
            f"videos/{key}/file_index": 0,
            f"videos/{key}/from_timestamp": first / self._fps,
            f"videos/{key}/to_timestamp": self._lengths[key] / self._fps,
        }

    def close(self) -> None:
        for film in self._films.values():
            film.close()


def film_feature(picture: Array, fps: float) -> dict[str, Any]:
    """LeRobot's description of a film of pictures like ``picture``, (H, W, 3)."""
    height, width = picture.shape[:2]
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        },
    }
