"""One picture of a film: two policies side by side, 1920 by 1080 pixels.

┌───────────────── MAD ────────────────┬───────────── Merged Only ────────────┐
│ the scene, drawn with shadows        │ the scene                            │
│ what each camera sends, its state    │ what each camera sends, its state    │
├──────────────────────────────────────┴──────────────────────────────────────┤
│ which cameras count; at the end, who succeeded and what was measured         │
└──────────────────────────────────────────────────────────────────────────────┘
"""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from madviz.agent.methods import METHODS, label_of
from madviz.drawing.colours import BAD, FAINT, GOOD, INK, MUTED, NOTE
from madviz.drawing.mosaic import GAP, mosaic
from madviz.recording.facts import condition_words
from madviz.recording.scene_view import SceneView
from madviz.session.frame import Frame
from madviz.types import Array

WIDTH = 1920
HEIGHT = 1080
HEADER = 116
SCENE = 600
STRIP = 248
"""Rows of the title, of a scene, and of the cameras' pictures; the words get the rest."""
SPACE = 16
"""Columns between the two sides."""
SIDE = (WIDTH - SPACE) // 2
LARGEST_TILE = 216
_GROUND = (30, 31, 34)


class FilmSide:
    """One policy's half of the picture."""

    def __init__(self, frame: Frame) -> None:
        self._scene = SceneView(frame, SIDE, SCENE)

    def begin(self, seed: int) -> None:
        """The episode of ``seed``."""
        self._scene.begin(seed)

    def picture(self, frame: Frame, actions: list[Array]) -> Array:
        """(SCENE + STRIP, SIDE, 3) uint8: the scene after ``actions``, and the cameras' tiles."""
        canvas = np.empty((SCENE + STRIP, SIDE, 3), np.uint8)
        canvas[:] = _GROUND
        canvas[:SCENE] = self._scene.picture(actions)
        count = len(frame.world.env.cameras)
        tile = min(LARGEST_TILE, (SIDE - GAP * (count - 1)) // count)
        tiles = mosaic(frame, tile)
        height, width = tiles.shape[:2]
        left = (SIDE - width) // 2
        below = SCENE + (STRIP - height) // 2
        canvas[below : below + height, left : left + width] = tiles
        return canvas

    def close(self) -> None:
        """Frees the scene's environment."""
        self._scene.close()


def whole_picture(frame: Frame, sides: list[Array], title: str, words: str) -> Array:
    """(HEIGHT, WIDTH, 3) uint8 of a comparison. ``sides``: the two halves, as ``FilmSide.picture``;
    ``words``: how the episode ended, '' before it has."""
    canvas = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    canvas[:] = _GROUND
    canvas[HEADER : HEADER + SCENE + STRIP, :SIDE] = sides[0]
    canvas[HEADER : HEADER + SCENE + STRIP, SIDE + SPACE :] = sides[1]
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    draw.text((20, 14), title, fill=INK, font=ImageFont.load_default(30))
    world = frame.world
    step = f"{world.env.task}   seed {world.seed}   step {world.step} of {world.env.horizon}"
    draw.text((WIDTH - 20, 20), step, fill=MUTED, font=ImageFont.load_default(22), anchor="ra")
    second = frame.second
    assert second is not None
    for left, side in ((0, frame), (SIDE + SPACE, second)):
        _name(draw, side, left)
    below = HEADER + SCENE + STRIP
    done = round(WIDTH * world.step / world.env.horizon)
    draw.rectangle((0, below, WIDTH, below + 4), fill=FAINT)
    draw.rectangle((0, below, done, below + 4), fill=INK)
    _lines(draw, words or f"Cameras: {condition_words(frame)}.", 20, below + 18, WIDTH - 40)
    return np.asarray(image)


def _name(draw: ImageDraw.ImageDraw, side: Frame, left: int) -> None:
    """The title of a half: policy, its sentence, and how its episode stands."""
    policy = side.world.policy
    known = METHODS.get(policy.method)
    words = known.page_words if known else ""
    draw.text(
        (left + 20, 68), words or label_of(policy), fill=NOTE, font=ImageFont.load_default(28)
    )
    if side.ended:
        word = "SUCCESS" if side.world.success else "FAIL"
        box = draw.textbbox(
            (left + SIDE - 24, HEADER + 20), word, font=ImageFont.load_default(44), anchor="ra"
        )
        draw.rectangle((box[0] - 14, box[1] - 10, box[2] + 14, box[3] + 10), fill=_GROUND)
        colour = GOOD if side.world.success else BAD
        draw.text(
            (left + SIDE - 24, HEADER + 20),
            word,
            fill=colour,
            font=ImageFont.load_default(44),
            anchor="ra",
        )


def _lines(draw: ImageDraw.ImageDraw, words: str, left: int, top: int, width: int) -> None:
    """``words`` in lines of at most ``width`` pixels, as large as two lines have room."""
    font = ImageFont.load_default(26)
    lines = [""]
    for word in words.split():
        longer = f"{lines[-1]} {word}".strip()
        if draw.textlength(longer, font=font) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    for number, line in enumerate(lines[:3]):
        draw.text((left, top + 34 * number), line, fill=INK, font=font)
