"""Films from pictures: MP4 files, encoded as H.264."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import IO, Any

import av
from av.error import FFmpegError

from madviz.types import Array

FAST = {"movflags": "+faststart"}
"""The table of contents stands first, so that a browser shows a film while it loads."""
REPEATABLE = {"threads": "1", "x264-params": "rc-lookahead=0:mbtree=0:bframes=0:scenecut=0"}
"""The same pictures give the same bytes, in a larger file. x264 does not look at later pictures
then: its costs there differ from run to run (of 20 films of the same pictures, 16 were different).
"""
SEEKABLE = {"g": "2"}
"""Every second picture stands for itself, so that any is found at once, as LeRobot has it."""


class Mp4:
    """A film of pictures of one size with even sides. ``close`` completes the file."""

    def __init__(
        self,
        out: Path | IO[bytes],
        fps: float,
        rate_factor: int = 18,
        options: Mapping[str, str] | None = None,
    ) -> None:
        """``rate_factor``: x264's crf; larger is smaller and worse. ``options``: more of x264's."""
        if isinstance(out, Path):
            self._file = av.open(str(out), "w", format="mp4", options=FAST)
        else:
            self._file = av.open(out, "w", format="mp4")
        self._fps = Fraction(fps).limit_denominator(1000)
        coded = {"crf": str(rate_factor), **(options or {})}
        self._stream: Any = self._file.add_stream("libx264", rate=self._fps, options=coded)
        self._stream.pix_fmt = "yuv420p"
        self._count = 0

    def add(self, picture: Array) -> None:
        """The next picture, (H, W, 3) uint8."""
        if not self._count:
            self._stream.height, self._stream.width = picture.shape[:2]
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts = self._count
        frame.time_base = 1 / self._fps
        self._count += 1
        self._file.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Writes what the encoder still holds, and the end of the file."""
        self._file.mux(self._stream.encode(None))
        self._file.close()


def decoded(film: IO[bytes], most: int) -> list[Array]:
    """At most ``most`` pictures (H, W, 3) of a film. Raises ValueError for what is none."""
    try:
        with av.open(film, "r") as file:
            frames = islice(file.decode(video=0), most)
            return [frame.to_ndarray(format="rgb24") for frame in frames]
    except FFmpegError as error:
        raise ValueError(f"expected a film, found: {error}") from error


def with_chapters(plain: Path, out: Path, chapters: Sequence[tuple[float, float, str]]) -> None:
    """Copies a film to ``out`` with chapters: begin and end in seconds, and a title. They stand at
    the begin of a file, so a film that was written before they are known is copied."""
    with av.open(str(plain)) as source, av.open(str(out), "w", format="mp4", options=FAST) as film:
        stream = film.add_stream_from_template(source.streams.video[0])
        film.set_chapters(
            [
                {
                    "id": number,
                    "start": round(1000 * begin),
                    "end": round(1000 * end),
                    "time_base": Fraction(1, 1000),
                    "metadata": {"title": title},
                }
                for number, (begin, end, title) in enumerate(chapters)
            ]
        )
        for packet in source.demux(video=0):
            if packet.dts is not None:  # The last one is empty.
                packet.stream = stream
                film.mux(packet)
