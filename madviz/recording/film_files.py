"""The files of a film: X.mp4 with chapters, and X.webp, which is small."""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

from madviz.system.mp4 import Mp4, with_chapters
from madviz.types import Array

SMALL_WIDTH = 880
SMALL_EVERY = 3
"""A small film's columns, and of how many decisions it shows one."""


class LargeFilm:
    """X.mp4, with chapters."""

    def __init__(self, path: Path, fps: float) -> None:
        self._path = path
        self._fps = fps
        self.seconds = 0.0
        """How long it is so far."""
        self._folder = tempfile.TemporaryDirectory()
        self._plain = Path(self._folder.name) / "film.mp4"
        self._film = Mp4(self._plain, fps)

    def add(self, picture: Array, seconds: float) -> None:
        """Writes a picture (H, W, 3) as often as its ``seconds`` ask for."""
        for _ in range(max(1, round(seconds * self._fps))):
            self._film.add(picture)
        self.seconds += seconds

    def close(self, titles: list[tuple[float, str]]) -> None:
        """Writes the chapters, whose beginnings in seconds, ``titles``, are known only now."""
        self._film.close()
        ends = [*(start for start, _ in titles[1:]), self.seconds]
        chapters = [(start, end, title) for (start, title), end in zip(titles, ends, strict=True)]
        with_chapters(self._plain, self._path, chapters)
        self._folder.cleanup()


class SmallFilm:
    """X.webp: fewer and smaller pictures, which start again at the end."""

    def __init__(self, path: Path) -> None:
        self.seconds = 0.0
        self._path = path
        self._shown: list[tuple[Image.Image, float]] = []
        self._passed = 0

    def add(self, picture: Array, seconds: float) -> None:
        """Takes a picture (H, W, 3); one that is left out gives its time to the one before it."""
        self.seconds += seconds
        self._passed += 1
        if self._shown and seconds < 1 and self._passed % SMALL_EVERY:
            last, lasts = self._shown[-1]
            self._shown[-1] = (last, lasts + seconds)
            return
        size = (SMALL_WIDTH, round(SMALL_WIDTH * picture.shape[0] / picture.shape[1]))
        small = Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS)
        self._shown.append((small, seconds))

    def close(self, titles: list[tuple[float, str]]) -> None:
        """Writes the file; this format has no chapters."""
        pictures = [picture for picture, _ in self._shown]
        pictures[0].save(
            self._path,
            format="webp",
            save_all=True,
            append_images=pictures[1:],
            duration=[round(1000 * seconds) for _, seconds in self._shown],
            loop=0,
            quality=50,
            method=4,
        )
