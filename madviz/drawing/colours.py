"""Colours with a meaning: one per camera, everywhere; good and bad differ in more than hue.

The camera colours are from Okabe and Ito's set, which stays distinct for colour-blind eyes.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from madviz.types import Array, CameraSpec

CAMERA_COLOURS = ("#E69F00", "#56B4E9", "#CC79A7", "#009E73", "#F0E442", "#D55E00")
MERGED = "#FFFFFF"
MUTED = "#9a9fa6"
INK = "#e8eaed"
FAINT = "#3a3d42"
GOOD = "#4db6ff"
BAD = "#ff8a3d"
NOTE = "#ffd166"
"""Success and failure: blue against orange, always with a word or a shape beside them."""
MERGED_ON_WHITE = "#222222"
_ON_WHITE = {"#F0E442": "#b3a600", "#56B4E9": "#2f8fc9", "#E69F00": "#c98500"}
"""Camera colours that are too bright on white, and what replaces them."""


def camera_colours(cameras: tuple[CameraSpec, ...]) -> dict[str, str]:
    """Camera name -> ``#rrggbb``, by position."""
    count = len(CAMERA_COLOURS)
    return {camera.name: CAMERA_COLOURS[i % count] for i, camera in enumerate(cameras)}


def colours_on_white(cameras: tuple[CameraSpec, ...]) -> dict[str, str]:
    """As ``camera_colours``, dark enough for thin lines on a white ground."""
    return {name: _ON_WHITE.get(own, own) for name, own in camera_colours(cameras).items()}


def rgb(colour: str) -> tuple[int, int, int]:
    """``#rrggbb`` -> 0..255 each."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def heat(unit: Array, colormap: int = cv2.COLORMAP_VIRIDIS) -> Array:
    """(H, W) in [0, 1] -> (H, W, 3) uint8 RGB."""
    bytes_ = np.round(np.clip(np.nan_to_num(unit), 0, 1) * 255).astype(np.uint8)
    return _colours_of(colormap)[bytes_]


@cache
def _colours_of(colormap: int) -> Array:
    """(256, 3) uint8 RGB. OpenCV computes a map anew at every call: 1 ms for a strip of 32."""
    every = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], colormap)
    return cv2.cvtColor(every, cv2.COLOR_BGR2RGB)[0]
