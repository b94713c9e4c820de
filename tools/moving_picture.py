"""docs/camera-dropped.webp: one episode under two policies, and a camera that is dropped in it.

    python tools/moving_picture.py

Both episodes have the same seed, so the same scene. They are recorded as ``madviz record`` does it,
side by side; what was recorded is printed.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image

from madviz.recording.record import RecordConfig, run_record

OUT = Path(__file__).resolve().parent.parent / "docs" / "camera-dropped.webp"
POLICIES = ("metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light")
FAILURE = "first@15"
SEED = 2003
WIDTH = 1000
GAP = 12
EVERY = 2
"""Of the decisions that are shown; a decision lasts as long as on the page."""
MILLISECONDS = 200


def film(policy: str, folder: Path) -> np.ndarray:
    """An episode's pictures (T H W 3), one for each decision."""
    config = RecordConfig(folder / f"{policy}.mp4", policy, seed=SEED, drop=(FAILURE,), tile=170)
    print(policy, run_record(config))
    return iio.imread(config.out)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        films = [film(policy, Path(folder)) for policy in POLICIES]
    length = max(len(one) for one in films)
    rows = [np.concatenate([one, np.repeat(one[-1:], length - len(one), 0)]) for one in films]
    gap = np.full((*rows[0].shape[:2], GAP, 3), 255, np.uint8)
    both = np.concatenate([rows[0], gap, rows[1]], 2)[::EVERY]
    pictures = [Image.fromarray(picture) for picture in both]
    size = (WIDTH, round(both.shape[1] * WIDTH / both.shape[2]))
    first, *others = [picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures]
    first.save(
        OUT,
        save_all=True,
        append_images=others,
        duration=MILLISECONDS,
        loop=0,
        quality=55,
        method=6,
    )
    print(OUT, f"{OUT.stat().st_size / 1e6:.2f} MB, {len(pictures)} pictures of {size}")


if __name__ == "__main__":
    main()
