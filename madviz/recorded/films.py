"""Pictures of one camera in one episode, from a film or from a table, one at a time.

A film may hold many episodes. It is opened at the key frame before the episode, and a picture
belongs to the step that its time is nearest to. No more pictures are decoded than the dataset says
there are, and none that is larger than it says.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
from av import error as av_error
from av.container import InputContainer
from av.video.stream import VideoStream
from PIL import Image

from madviz.errors import UserError
from madviz.recorded.description import RecordedCamera
from madviz.recorded.tables import AT_ONCE, read_rows
from madviz.types import Array

MARGIN = 64
"""Rows and columns that a codec may add to a picture, and pictures before an episode's first."""


def check_film(path: Path, camera: RecordedCamera, fps: float, end: float) -> str:
    """Why the film cannot have all pictures until ``end`` (seconds); '' if it can. Only its header
    is read: how many pictures there are, and whether the file is as long as they need."""
    try:
        with _opened(path) as film:
            stream = _stream(film, path)
            codec = stream.codec_context
            if (codec.height, codec.width) != (camera.height, camera.width):
                said = f"{camera.height} x {camera.width}"
                return f"expected pictures of {said}, found {codec.height} x {codec.width}"
            entries = stream.index_entries
            size = path.stat().st_size
            there = sum(entry.pos + entry.size <= size for entry in entries)
            wanted = round(end * fps)
            if there < len(entries):
                found = f"truncated: {there} of {len(entries)} pictures"
                return "" if there >= wanted else found
            seconds = float((stream.duration or 0) * (stream.time_base or 0))
            if there > 1.5 * seconds * fps + MARGIN:
                return f"expected {fps:g} pictures a second, found {there} in {seconds:.1f} s"
            return "" if there >= wanted else f"expected {wanted} pictures, found {there}"
    except UserError as error:
        return str(error)


def film_pictures(
    path: Path, camera: RecordedCamera, fps: float, start: float, steps: int
) -> Iterator[tuple[int, Array]]:
    """(step, picture (H, W, 3) uint8) for the ``steps`` after ``start`` (seconds), in the order of
    the film. Raises UserError for one that cannot be decoded or lacks some."""
    decoded = 0
    most = round(start * fps) + steps + MARGIN
    found = np.zeros(steps, bool)
    with _opened(path) as film:
        stream = _stream(film, path)
        stream.thread_type = "AUTO"
        pixels = (camera.height + MARGIN) * (camera.width + MARGIN)
        stream.codec_context.options = {"max_pixels": str(pixels)}
        base = float(stream.time_base or 1)
        try:
            film.seek(max(0, round(start / base) - 1), stream=stream)
            for frame in film.decode(stream):
                decoded += 1
                if decoded > most:
                    raise UserError(f"{path}: expected at most {most} pictures, found more")
                step = round(((frame.pts or 0) * base - start) * fps)
                if step >= steps:
                    break
                if step < 0 or found[step]:
                    continue
                if (frame.height, frame.width) != (camera.height, camera.width):
                    raise UserError(f"{path}: expected pictures of one size, found another inside")
                found[step] = True
                yield step, frame.to_ndarray(format="rgb24")
        except (av_error.FFmpegError, ValueError, MemoryError) as error:
            if isinstance(error, UserError):
                raise
            raise UserError(f"{path}: expected a film, found: {_why(error)}") from error
    if not found.all():
        missing = int(np.argmin(found))
        raise UserError(f"{path}: expected {steps} pictures, found none for step {missing}")


def table_pictures(
    path: Path, camera: RecordedCamera, first: int, steps: int
) -> Iterator[tuple[int, Array]]:
    """(step, picture (H, W, 3) uint8) from ``steps`` rows from ``first`` on. Raises UserError for
    one that cannot be decoded, or of another size than was said."""
    step = 0
    for batch in read_rows(path, [camera.key], first, steps, AT_ONCE):
        for row in batch.column(camera.key).to_pylist():
            content = row.get("bytes") if isinstance(row, dict) else None
            if not isinstance(content, bytes):
                raise UserError(f"{path}: expected pictures in {camera.key!r}, found none")
            yield step, _picture(content, camera, path)
            step += 1


def letterboxed(picture: Array, size: int) -> Array:
    """(H, W, 3) -> (size, size, 3): its longer side fits, the rest is black; never squashed."""
    height, width = picture.shape[:2]
    rows, columns = between_bars(height, width, size)
    way = cv2.INTER_AREA if size < max(height, width) else cv2.INTER_LINEAR
    shape = (columns.stop - columns.start, rows.stop - rows.start)
    whole = np.zeros((size, size, 3), np.uint8)
    whole[rows, columns] = cv2.resize(picture, shape, interpolation=way)
    return whole


def between_bars(height: int, width: int, size: int) -> tuple[slice, slice]:
    """Rows and columns of a ``letterboxed`` picture that show the camera's ``height`` by
    ``width``."""
    scale = size / max(height, width)
    rows = max(1, round(height * scale))
    columns = max(1, round(width * scale))
    top = (size - rows) // 2
    left = (size - columns) // 2
    return slice(top, top + rows), slice(left, left + columns)


DARK = 8.0
"""The mean of 255 up to which bars count as black: JPEG does not keep them even."""


def has_bars(picture: Array, height: int, width: int) -> bool:
    """True for a square ``picture`` (S, S, C), dark where ``letterboxed`` makes the bars of a
    camera of ``height`` by ``width``."""
    outside = np.ones(picture.shape[:2], bool)
    outside[between_bars(height, width, len(picture))] = False
    return not outside.any() or float(picture[outside].mean()) <= DARK


def _picture(content: bytes, camera: RecordedCamera, path: Path) -> Array:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(content))
        if (image.height, image.width) != (camera.height, camera.width):
            raise ValueError(f"{image.height} x {image.width} pixels")
        return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Warning, Image.DecompressionBombError) as error:
        said = f"{camera.height} x {camera.width}"
        found = f"{error}".replace(repr(content), "")
        raise UserError(
            f"{path}: expected a picture of {said} in {camera.key!r}, found: {found:.100}"
        ) from error


def _opened(path: Path) -> InputContainer:
    if not path.is_file():
        raise UserError(f"{path}: expected a film, found none")
    try:
        # Only mp4: other formats may name further files.
        return av.open(str(path), format="mp4", metadata_errors="replace")
    except (av_error.FFmpegError, OSError, ValueError) as error:
        raise UserError(f"{path}: expected a film (mp4), found: {_why(error)}") from error


def _stream(film: InputContainer, path: Path) -> VideoStream:
    if not film.streams.video:
        raise UserError(f"{path}: expected a film, found no pictures in it")
    return film.streams.video[0]


def _why(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error or "too large")
