"""Films from pictures."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import av
import numpy as np

from madviz.system.mp4 import REPEATABLE, Mp4, with_chapters


def film() -> bytes:
    """Twenty pictures that move; memory is filled with other numbers in between."""
    out = BytesIO()
    written = Mp4(out, fps=10, rate_factor=30, options=REPEATABLE)
    picture = np.random.default_rng(0).integers(0, 255, (348, 340, 3), np.uint8)
    for step in range(20):
        used = np.full(10_000 * (id(written) % 7 + step), step, np.uint8)
        del used
        written.add(np.roll(picture, step, 1))
    written.close()
    return out.getvalue()


def test_the_same_pictures_give_the_same_bytes() -> None:
    assert len({film() for _ in range(5)}) == 1


def test_a_film_is_copied_with_its_chapters(tmp_path: Path) -> None:
    (tmp_path / "plain.mp4").write_bytes(film())
    with_chapters(tmp_path / "plain.mp4", tmp_path / "x.mp4", [(0, 0.5, "a; b = c"), (0.5, 2, "d")])
    with av.open(str(tmp_path / "x.mp4")) as read:
        chapters = [(c["start"], c["end"], c["metadata"]["title"]) for c in read.chapters()]
        assert sum(1 for _ in read.decode(video=0)) == 20
    assert chapters == [(0, 500, "a; b = c"), (500, 2000, "d")]
