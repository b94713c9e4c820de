"""A part of the tests that runs here, in LeRobot's own environment.

    .venv/bin/python check_recordings.py DATASET CODEC FILE.npz

Writes a dataset by LeRobot's writer, with films in CODEC (``images``: pictures in the tables),
reads every frame of it by LeRobot's loader, and keeps what came in FILE.npz, with the seconds it
took.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

FPS = 30
LENGTHS = (40, 33, 47)
TASKS = ("Pick up the ö.", "箱を押す", "Pick up the ö.")
SIZES = {"top": (240, 320), "wrist": (120, 90)}


def written(folder: Path, codec: str) -> None:
    """A dataset of moving squares on noise that changes slowly."""
    kind = "image" if codec == "images" else "video"
    axes = ["height", "width", "channels"]
    features = {
        f"observation.images.{name}": {"dtype": kind, "shape": (*size, 3), "names": axes}
        for name, size in SIZES.items()
    }
    for key in ("observation.state", "action"):
        features[key] = {"dtype": "float32", "shape": (7,), "names": [f"j{n}" for n in range(7)]}
    encoder = None if codec == "images" else RGBEncoderConfig(vcodec=codec)
    dataset = LeRobotDataset.create(
        "madviz/recorded",
        FPS,
        features,
        root=folder,
        use_videos=kind == "video",
        rgb_encoder=encoder,
    )
    rng = np.random.default_rng(0)
    for episode, (length, task) in enumerate(zip(LENGTHS, TASKS, strict=True)):
        for step in range(length):
            frame: dict[str, object] = {"task": task}
            for name, (rows, columns) in SIZES.items():
                wave = np.linspace(0, 3 + episode, columns) + step / 9
                picture = np.empty((rows, columns, 3), np.uint8)
                picture[:] = (120 + 80 * np.sin(wave))[None, :, None]
                picture[..., 1] = np.linspace(20, 230, rows)[:, None]
                picture[2 * step : 2 * step + 20, 30:60] = (250, 20, 20 * episode)
                frame[f"observation.images.{name}"] = picture
            for key in ("observation.state", "action"):
                frame[key] = rng.normal(size=7).astype(np.float32)
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()


def as_bytes(picture: np.ndarray) -> np.ndarray:
    """(3, H, W), in [0, 1] where it was in a table, -> (H, W, 3) uint8."""
    whole = picture if picture.dtype == np.uint8 else np.rint(255 * picture).astype(np.uint8)
    return whole.transpose(1, 2, 0)


def main() -> None:
    folder, codec, file = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    written(folder, codec)
    dataset = LeRobotDataset(
        "madviz/recorded", root=folder, video_backend="pyav", return_uint8=True
    )
    rows = []
    began = time.perf_counter()
    for index in range(len(dataset)):
        rows.append(dataset[index])
    seconds = time.perf_counter() - began
    found = {
        f"observation.images.{name}": np.stack(
            [as_bytes(np.asarray(row[f"observation.images.{name}"])) for row in rows]
        )
        for name in SIZES
    }
    for key in ("observation.state", "action", "episode_index"):
        found[key] = np.stack([np.asarray(row[key]) for row in rows])
    np.savez(file, seconds=seconds, tasks=np.array([row["task"] for row in rows]), **found)


if __name__ == "__main__":
    main()
