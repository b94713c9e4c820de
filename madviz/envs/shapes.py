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
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))]
    return corners * np.asarray(half, float), np.array(triangles)


def cylinder(radius: float, half: float) -> Shape:
    """Along z from ``-half`` to ``half``, closed."""
    return _turned(np.array([[0, -half], [radius, -half], [radius, half], [0, half]]))


def sphere(radii: Array) -> Shape:
    """An ellipsoid with the half axes ``radii`` (3,)."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, AROUND // 2 + 1)
    vertices, triangles = _turned(np.c_[np.cos(angles), np.sin(angles)])
    return vertices * np.asarray(radii, float), triangles


def capsule(radius: float, half: float) -> Shape:
    """Along z; ``half`` is half the length of its straight piece."""
    below, above = np.linspace(-np.pi / 2, 0, 7), np.linspace(0, np.pi / 2, 7)
    outline = [radius * np.c_[np.cos(a), np.sin(a)] + [0, s * half] for a, s in
               ((below, -1), (above, 1))]  # fmt: skip
    return _turned(np.concatenate(outline))


def _turned(outline: Array) -> Shape:
    """The solid that ``outline`` (n, 2), radius and height from its lower to its upper pole,
    sweeps when it is turned about z."""
    angles = np.arange(AROUND) * 2 * np.pi / AROUND
    ring = np.c_[np.cos(angles), np.sin(angles)]
    middle = outline[1:-1]
    rings = [np.c_[r * ring, np.full(AROUND, z)] for r, z in middle]
    poles = np.array([[0, 0, outline[0, 1]], [0, 0, outline[-1, 1]]])
    here = np.arange(AROUND)
    following = (here + 1) % AROUND
    last, below, above = (len(middle) - 1) * AROUND, len(middle) * AROUND, len(middle) * AROUND + 1
    faces = [np.c_[np.full(AROUND, below), following, here]]
    for start in range(0, last, AROUND):
        a, b = start + here, start + following
        faces += [np.c_[a, b, b + AROUND], np.c_[a, b + AROUND, a + AROUND]]
    faces.append(np.c_[last + here, last + following, np.full(AROUND, above)])
    return np.concatenate([*rings, poles]), np.concatenate(faces)
