"""A policy of your own: three methods and a spec, here without any network.

    madviz explore --policy madviz.examples.own_policy:make

``encode`` makes one feature per camera, ``read`` merges those that are present and acts, under many
sets of cameras at once, and ``supports`` says which sets it can act on. With networks of yours,
``encode`` calls the encoder and ``read`` the head.

This one counts pixels. A camera that sees n pixels of the target, around (x, y) metres, says
(n x, n y, n). The features are merged by summing, and the sum's first two numbers over its third
are the middle of all target pixels in all pictures: 30 at (0.5, 0.2) and 10 at (0.1, 0.2) say
(16, 8, 40), which is (0.4, 0.2). So it acts on any cameras, as a policy trained with MAD does.
"""

from __future__ import annotations

import numpy as np

from madviz.envs.toy import CAMERAS, STEP
from madviz.types import Array, Encoded, PolicySpec, Readout

ORANGE = (230, 90, 40)
WIDTH = {"first": 0.9, "third_a": 1.5, "third_b": 1.15}
"""Metres from the middle of a camera's picture to its edge."""
TURN = {"first": 0.0, "third_a": np.pi / 4, "third_b": 0.0}
"""Radians by which a camera's picture is turned about the vertical."""


class Finder:
    """Goes where it sees orange; stays where it sees none."""

    spec = PolicySpec(
        name="finder",
        task="toy/reach",
        method="pixels",
        setting="three",
        recipe="by hand",
        streams=tuple(camera.name for camera in CAMERAS),
        trained_subsets=("all", *(camera.name for camera in CAMERAS)),
        digest="finder-1",  # Name another whenever it acts otherwise: results are stored under it.
    )

    def encode(self, views: Array, state: Array) -> Encoded:
        """``views`` (V, C, H, W) uint8, the newest frame in the last three channels."""
        hand = state[-2:]
        seen = [
            found(camera, picture[-3:], hand)
            for camera, picture in zip(self.spec.streams, views, strict=True)
        ]
        return Encoded(np.array(seen, np.float32), state)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        """``masks`` (N, V) bool."""
        hand = encoded.state[-2:]
        merged = masks.astype(np.float32) @ encoded.features
        count = merged[:, 2:]
        target = np.where(count > 0, merged[:, :2] / np.maximum(count, 1), hand)
        action = np.clip((target - hand) / STEP, -1, 1).astype(np.float32)
        return Readout(merged, action, q=np.full(len(masks), np.nan, np.float32))

    def supports(self, mask: Array) -> bool:
        return True


def found(camera: str, picture: Array, hand: Array) -> Array:
    """(3,): n x, n y and n of the orange pixels in ``picture`` (3, H, W), metres in the world."""
    off = np.abs(picture.astype(int) - np.array(ORANGE)[:, None, None]).max(0)
    rows, columns = np.nonzero(off < 40)
    half = picture.shape[-1] / 2
    right = (columns + 0.5 - half) / half
    up = (half - rows - 0.5) / half
    x = WIDTH[camera] * right
    y = WIDTH[camera] * up
    sin = np.sin(TURN[camera])
    cos = np.cos(TURN[camera])
    origin = hand if camera == "first" else np.zeros(2)
    where = np.stack([cos * x - sin * y, sin * x + cos * y]) + origin[:, None]
    return np.array([*where.sum(1), len(rows)])


def make() -> Finder:
    """The factory that ``--policy madviz.examples.own_policy:make`` calls."""
    return Finder()
