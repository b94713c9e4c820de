"""The shapes a scene is drawn with on the page: the simulator's own, light enough for any browser.

A page is drawn by whatever machine the visitor has, often without a GPU. The Sawyer's meshes alone
hold 67,000 triangles and the Panda's wrist camera 425,000, so each heavy mesh is decimated (see
``decimation.decimate``) to at most ``LIGHT`` triangles, and a whole scene stays below
``MOST``: 11 links x 600 + a wooden table of 320 = 6,920. Boxes, cylinders, spheres and capsules are
described by numbers in a simulator; here they become triangles too.

Everything is in the frame of its body, in metres, triangles counter-clockwise seen from outside.
"""

from __future__ import annotations

import numpy as np
import trimesh.creation
from scipy.spatial.transform import Rotation

from madviz.envs.decimation import ENOUGH, decimate
from madviz.types import Array, Part

MOST = 20_000
"""Triangles of a whole scene."""
LIGHT = 600
"""Triangles a heavier mesh is decimated to, roughly."""
AROUND = 24
"""Corners of a round outline."""

Shape = tuple[Array, Array]
"""Vertices (n, 3) metres and triangles (m, 3)."""


def part(
    shape: Shape,
    colour: Array,
    position: Array | tuple[float, float, float] = (0.0, 0.0, 0.0),
    wxyz: Array | tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Part:
    """``shape`` placed in its body's frame and made light; ``colour`` (3,) in [0, 1]."""
    vertices, triangles = shape
    if len(triangles) > ENOUGH * LIGHT:
        vertices, triangles = decimate(vertices, triangles, LIGHT)
    turned = Rotation.from_quat(wxyz, scalar_first=True).apply(np.asarray(vertices, float))
    return Part(
        (turned + np.asarray(position, float)).astype(np.float32),
        np.ascontiguousarray(triangles, np.int32),
        np.round(255 * np.clip(np.asarray(colour, float), 0, 1)).astype(np.uint8),
    )


def box(half: Array) -> Shape:
    """``half`` (3,) half the edges."""
    solid = trimesh.creation.box(2 * np.asarray(half, float))
    return solid.vertices, solid.faces


def cylinder(radius: float, half: float) -> Shape:
    """Along z from ``-half`` to ``half``, closed."""
    return _revolved(np.array([[0, -1], [1, -1], [1, 1], [0, 1]]), (radius, radius, half))


def sphere(radii: Array) -> Shape:
    """An ellipsoid with the half axes ``radii`` (3,)."""
    return _revolved(_arc(-np.pi / 2, np.pi / 2, AROUND // 2), radii)


def capsule(radius: float, half: float) -> Shape:
    """Along z; ``half`` is half the length of its straight piece."""
    straight = np.array([0, half / radius])
    below = _arc(-np.pi / 2, 0, AROUND // 4) - straight
    above = _arc(0, np.pi / 2, AROUND // 4) + straight
    return _revolved(np.concatenate([below, above]), (radius, radius, radius))


def _arc(start: float, end: float, steps: int) -> Array:
    """(steps + 1, 2) points of the unit circle between two angles."""
    angles = np.linspace(start, end, steps + 1)
    return np.c_[np.cos(angles), np.sin(angles)]


def _revolved(outline: Array, size: Array | tuple[float, float, float]) -> Shape:
    """The solid that ``outline`` (n, 2), radius and height from its lower to its upper pole,
    sweeps when it is turned about z, times ``size`` (3,). Scaled at the end, as trimesh takes a
    triangle below 1e-8 for none."""
    solid = trimesh.creation.revolve(outline, sections=AROUND)
    return solid.vertices * np.asarray(size, float), solid.faces
