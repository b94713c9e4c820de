"""Small LeRobot datasets, written without any code of madviz: tables by pyarrow, films by av.

Every picture's left half has the grey level ``level(episode, step)``; its right half is black.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
TOP = "observation.images.top"
WRIST = "observation.images.wrist"
DATA_FILE = "data/chunk-000/file-000.parquet"
EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
TASKS = ("Hebe den Würfel auf.", "箱を押す")


@dataclass
class Small:
    """A dataset in memory, to change before it is written."""

    episodes: int = 3
    steps: int = 6
    fps: float = 10
    sizes: dict[str, tuple[int, int]] = field(
        default_factory=lambda: {TOP: (48, 64), WRIST: (64, 48)}
    )
    """Rows and columns by column."""
    films: bool = True
    """Films beside the tables, or pictures in them."""
    codec: str = "libx264"
    frames: int | None = None
    """Pictures in each film; by default as many as there are steps."""
    film_size: tuple[int, int] | None = None
    numbers: int = 3

    def __post_init__(self) -> None:
        rng = np.random.default_rng(0)
        total = self.episodes * self.steps
        self.states = rng.uniform(-2, 3, (total, self.numbers)).astype(np.float32)
        self.actions = rng.uniform(-2, 3, (total, self.numbers)).astype(np.float32)
        self.info: dict[str, Any] = self._info()
        self.rows: dict[str, Any] = self._rows()
        self.places: list[dict[str, Any]] = [self._place(index) for index in range(self.episodes)]

    def write(self, folder: Path) -> Path:
        """Writes the dataset; returns ``folder``."""
        for name in ("meta/episodes/chunk-000", "data/chunk-000"):
            (folder / name).mkdir(parents=True)
        (folder / "meta/info.json").write_text(json.dumps(self.info), encoding="utf-8")
        tasks = pa.table({"task_index": range(len(TASKS)), "task": list(TASKS)})
        pq.write_table(tasks, folder / "meta/tasks.parquet")
        pq.write_table(pa.Table.from_pylist(self.places), folder / EPISODES_FILE)
        pq.write_table(pa.table(self.rows), folder / DATA_FILE, row_group_size=self.steps)
        if self.films:
            for key, size in self.sizes.items():
                path = folder / VIDEO.format(video_key=key, chunk_index=0, file_index=0)
                path.parent.mkdir(parents=True)
                write_film(path, self._pictures(self.film_size or size), self.fps, self.codec)
        return folder

    def _pictures(self, size: tuple[int, int]) -> list[np.ndarray]:
        count = self.episodes * self.steps if self.frames is None else self.frames
        return [picture(*divmod(number, self.steps), size) for number in range(count)]

    def _info(self) -> dict[str, Any]:
        names = [f"joint {number}" for number in range(self.numbers)]
        motors = {"dtype": "float32", "shape": [self.numbers], "names": names}
        kind = "video" if self.films else "image"
        axes = ["height", "width", "channels"]
        cameras = {
            key: {"dtype": kind, "shape": [*size, 3], "names": axes}
            for key, size in self.sizes.items()
        }
        return {
            "codebase_version": "v3.0",
            "fps": self.fps,
            "features": {**cameras, "observation.state": motors, "action": motors},
            "total_episodes": self.episodes,
            "total_frames": self.episodes * self.steps,
            "data_path": DATA,
            "video_path": VIDEO if self.films else None,
        }

    def _rows(self) -> dict[str, Any]:
        total = self.episodes * self.steps
        step = np.arange(total) % self.steps
        rows: dict[str, Any] = {
            "observation.state": list(self.states),
            "action": list(self.actions),
            "timestamp": pa.array(step / self.fps, pa.float32()),
            "frame_index": step,
            "episode_index": np.arange(total) // self.steps,
            "index": np.arange(total),
            "task_index": np.arange(total) // self.steps % len(TASKS),
        }
        if not self.films:
            for key, size in self.sizes.items():
                pictures = [picture(*divmod(n, self.steps), size) for n in range(total)]
                rows[key] = [{"bytes": png(one), "path": None} for one in pictures]
        return rows

    def _place(self, index: int) -> dict[str, Any]:
        place: dict[str, Any] = {
            "episode_index": index,
            "tasks": [TASKS[index % len(TASKS)]],
            "length": self.steps,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": index * self.steps,
            "dataset_to_index": (index + 1) * self.steps,
        }
        for key in self.sizes if self.films else ():
            begin = index * self.steps / self.fps
            where = {"chunk_index": 0, "file_index": 0, "from_timestamp": begin}
            where["to_timestamp"] = begin + self.steps / self.fps
            place.update({f"videos/{key}/{word}": value for word, value in where.items()})
        return place


def level(episode: int, step: int) -> int:
    """The grey level of a picture's left half."""
    return 30 + 60 * (episode % 3) + 8 * (step % 6)


def picture(episode: int, step: int, size: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) uint8."""
    whole = np.zeros((*size, 3), np.uint8)
    whole[:, : size[1] // 2] = level(episode, step)
    return whole


def png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def write_film(path: Path, pictures: list[np.ndarray], fps: float, codec: str) -> None:
    """A film with a key frame every second picture, and its header first, as LeRobot's."""
    options = {"g": "2", "crf": "20"} | ({"svtav1-params": "lp=1"} if "av1" in codec else {})
    with av.open(str(path), "w", options={"movflags": "faststart"}) as film:
        stream: Any = film.add_stream(codec, Fraction(fps), options=options)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for one in pictures:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(one)))
        film.mux(stream.encode())
