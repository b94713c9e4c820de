"""Small pictures of single cameras, beside the large one: on frusta and in tables."""

from __future__ import annotations

import cv2
import numpy as np

from madviz.drawing.colours import NOTE, rgb
from madviz.drawing.jpeg import jpeg_url
from madviz.drawing.mosaic import of_stream
from madviz.session.frame import Frame
from madviz.types import Array

TILE = 84
"""Pixels of a camera's picture in a strip."""


def picture(frame: Frame, camera: str) -> Array:
    """(H, W, 3) uint8: what arrives of the camera's colour, in a striped frame if it is occluded;
    dim and grey where nothing of it reaches the policy."""
    raw = frame.world.views[camera].rgb
    state = frame.camera(camera)
    if not frame.uses(camera):
        return (0.25 * raw.mean(axis=2, keepdims=True)).astype(np.uint8).repeat(3, axis=2)
    arrived = of_stream(frame.world.arrived, camera, "rgb")
    seen = raw if arrived is None else arrived  # (H, W, 3)
    return seen if state.occlusion.kind == "none" else striped(seen)


def striped(seen: Array) -> Array:
    """A copy of ``seen`` (H, W, 3) whose outer twelfth is diagonal stripes."""
    height, width = seen.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    edge = min(height, width) // 12
    inside = (rows >= edge) & (rows < height - edge) & (columns >= edge) & (columns < width - edge)
    bright = ((rows + columns) // max(edge, 1)) % 2 == 0
    stripes = np.where(bright[..., None], np.array(rgb(NOTE), np.uint8), np.uint8(30))
    return np.where(inside[..., None], seen, stripes).astype(np.uint8)


def strip_html(frame: Frame, alt: str) -> str:
    """An image of all cameras side by side."""
    tiles = [
        cv2.resize(picture(frame, camera.name), (TILE, TILE), interpolation=cv2.INTER_NEAREST)
        for camera in frame.world.env.cameras
    ]
    strip = np.concatenate(tiles, axis=1)
    return f'<img width="{strip.shape[1]}" height="{TILE}" src="{jpeg_url(strip)}" alt="{alt}">'
