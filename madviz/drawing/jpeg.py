"""Pictures as JPEG, one quality everywhere: for the page, recordings, widgets and lessons."""

from __future__ import annotations

from base64 import b64encode

import cv2

from madviz.types import Array

QUALITY = 88


def jpeg(picture: Array) -> bytes:
    """(H, W, 3) RGB or (H, W, 1) uint8 -> a JPEG file."""
    pixels = picture if picture.shape[2] == 1 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    done, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    return encoded.tobytes()


def jpeg_url(picture: Array) -> str:
    """(H, W, 3) RGB or (H, W, 1) uint8 -> a data URL, for the ``src`` of an image."""
    return "data:image/jpeg;base64," + b64encode(jpeg(picture)).decode()
