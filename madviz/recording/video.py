"""A film of an episode: the page's mosaic, a line with its state, and Q under it.

The curve of Q is drawn as far as the episode has come, with a mark wherever the cameras' states
changed, so that a viewer who stops the film sees what a lost camera did.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from madviz.drawing.colours import BAD, FAINT, GOOD, INK, MUTED, NOTE, rgb
from madviz.drawing.mosaic import mosaic
from madviz.recording.facts import Facts, condition_words, headline, verdict
from madviz.session.frame import Frame
from madviz.system.mp4 import Mp4
from madviz.types import Array

CAPTION = 52
CURVE = 64
"""Pixels under the mosaic: two lines of text, and the curve."""
_GROUND = (30, 31, 34)
HOLD = 1.5
"""Seconds for which the last picture stays."""


class VideoWriter:
    """See the module."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._path = path
        self._facts = facts
        self._film: Mp4 | None = None
        self._q: list[float] = []
        self._marks: list[int] = []
        self._setting: object = None
        self._last: Array | None = None

    def add(self, frame: Frame) -> None:
        if self._film is None:
            self._film = Mp4(self._path, self._facts.fps)
        if self._setting not in (None, frame.condition):
            self._marks.append(frame.world.step)
        self._setting = frame.condition
        self._q.append(frame.q)
        self._last = self._picture(frame)
        self._film.add(self._last)

    def close(self) -> None:
        if self._film is None or self._last is None:
            return
        film = self._film
        self._film = None
        for _ in range(round(HOLD * self._facts.fps)):
            film.add(self._last)
        film.close()

    def _picture(self, frame: Frame) -> Array:
        """(H, W, 3) uint8 with even sides: films have no odd ones."""
        tiles = mosaic(frame, self._facts.tile)
        caption = _caption(frame, self._facts, tiles.shape[1])
        curve = _curve(self._q, self._marks, frame.world.env.horizon, tiles.shape[1])
        whole = np.concatenate([tiles, caption, curve])
        height, width = whole.shape[:2]
        return np.pad(whole, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _caption(frame: Frame, facts: Facts, width: int) -> Array:
    """(CAPTION, width, 3): what this is, and its state."""
    image = Image.new("RGB", (width, CAPTION), _GROUND)
    draw = ImageDraw.Draw(image)
    _text(draw, headline(frame, facts), 6, 6, width - 12, MUTED)
    colour = (
        (GOOD if frame.world.success else BAD)
        if frame.ended
        else NOTE
        if frame.world.success
        else INK
    )
    state = f"step {frame.world.step}/{frame.world.env.horizon}  cameras: {condition_words(frame)}"
    _text(draw, state, 6, 28, width - 130, INK)
    draw.text(
        (width - 6, 28), verdict(frame), fill=colour, font=ImageFont.load_default(15), anchor="ra"
    )
    return np.asarray(image)


def _text(draw: ImageDraw.ImageDraw, words: str, x: int, y: int, width: int, colour: str) -> None:
    """Words in at most ``width`` pixels; what does not fit is left out with dots."""
    font = ImageFont.load_default(14)
    while draw.textlength(words, font=font) > width and len(words) > 4:
        words = words[:-4].rstrip() + "..."
    draw.text((x, y), words.replace("·", "|"), fill=colour, font=font)


def _curve(values: list[float], marks: list[int], horizon: int, width: int) -> Array:
    """(CURVE, width, 3): Q over the episode, scaled to what it has been so far."""
    canvas = np.empty((CURVE, width, 3), np.uint8)
    canvas[:] = _GROUND
    canvas[0] = rgb(FAINT)
    known = [value for value in values if np.isfinite(value)]
    if not known:
        return canvas
    low = min(known)
    high = max(known)
    span = max(high - low, 1e-6)
    across = (width - 60) / max(horizon, 1)
    for mark in marks:
        cv2.line(canvas, (round(50 + mark * across), 4), (round(50 + mark * across), 60), rgb(NOTE))
    points = [
        (round(50 + step * across), round(CURVE - 6 - (value - low) / span * (CURVE - 14)))
        for step, value in enumerate(values)
        if np.isfinite(value)
    ]
    cv2.polylines(canvas, [np.array(points, np.int32)], False, rgb(GOOD), 1, cv2.LINE_AA)
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    draw.text((6, 6), f"Q {high:.1f}", fill=MUTED, font=ImageFont.load_default(11))
    draw.text((6, CURVE - 18), f"Q {low:.1f}", fill=MUTED, font=ImageFont.load_default(11))
    return np.asarray(image)
