"""Depth in metres, and the 256 steps in which a policy gets it: one definition for every way out.

A depth is clipped to its camera's ``depth_range`` and coded 0..255. Gymnasium, Stable-Baselines3
and datasets get the metres of that code, datasets in whole millimetres, so all of them hold the
same numbers.
"""

from __future__ import annotations

import numpy as np

from madviz.types import Array


def depth_code(depth: Array, depth_range: tuple[float, float]) -> Array:
    """(H, W) metres -> (H, W, 1) uint8 over ``depth_range``."""
    near, far = depth_range
    unit = np.clip((depth - near) / (far - near), 0, 1)
    return np.round(unit * 255).astype(np.uint8)[..., None]


def depth_metres(code: Array, depth_range: tuple[float, float]) -> Array:
    """The metres (float32) of a ``depth_code`` of any shape, from near to far."""
    near, far = depth_range
    metres = near + code.astype(np.float32) / 255 * (far - near)
    return np.clip(metres, np.float32(near), np.float32(far))


def depth_millimetres(code: Array, depth_range: tuple[float, float]) -> Array:
    """``depth_metres`` in whole millimetres (uint16): depths up to 65.535 m."""
    return np.round(depth_metres(code, depth_range) * 1000).astype(np.uint16)
