"""Fewer triangles for the same shape: fast_simplification, one call at a time.

The library works in variables of its own. Two simulators that open at once, each in its visitor's
thread, would get each other's triangles, or none: the robot that a policy sees would have holes.
"""

from __future__ import annotations

import threading
from hashlib import blake2b
from typing import Any

import fast_simplification
import numpy as np

from madviz.types import Array

TRIANGLES = 1000
"""The number of faces that the fast render profile decimates a heavier mesh to."""
ENOUGH = 1.5
"""Times the wanted number of triangles that are few enough to leave a mesh alone."""

_ONE_AT_A_TIME = threading.Lock()
_DONE: dict[bytes, tuple[Array, Array]] = {}
"""Results by a digest of their arguments: all tasks of a suite have the same robot, 0.5 MB of them,
and another task opens 0.2 s earlier."""


def simplify(
    vertices: Array, triangles: Array, share: float, aggressiveness: float = 7.0
) -> tuple[Array, Array]:
    """Vertices (n, 3) and triangles (m, 3) of the same shape without about ``share`` of its
    triangles, by quadric error; ``aggressiveness`` is how fast the allowed error grows."""
    call: Any = fast_simplification.simplify  # Its types say less than it takes.
    numbers = np.array([vertices.size, share, aggressiveness])
    asked = blake2b(numbers.tobytes() + vertices.tobytes() + triangles.tobytes()).digest()
    with _ONE_AT_A_TIME:
        if asked not in _DONE:
            _DONE[asked] = call(vertices, triangles, share, agg=aggressiveness)[:2]
        small, faces = _DONE[asked]
    return small.copy(), faces.copy()


def decimate(vertices: Array, triangles: Array, wanted: int = TRIANGLES) -> tuple[Array, Array]:
    """About ``wanted`` triangles of the same shape. Files repeat a vertex for every triangle
    that has it, which would stop edges from collapsing, so equal ones are welded first; in a huge
    mesh, those that nearly are."""
    if len(triangles) > 50 * TRIANGLES:
        small, faces = snap(vertices, triangles, 256)
    else:
        rows = np.ascontiguousarray(vertices, np.float32).view([("", np.float32)] * 3).ravel()
        unique, place = np.unique(rows, return_inverse=True)
        small = unique.view(np.float32).reshape(-1, 3)
        faces = place.reshape(-1)[triangles].astype(np.int32)
    for aggressiveness in (7.0, 9.0):
        if len(faces) > ENOUGH * wanted:
            share = 1 - wanted / len(faces)
            small, faces = simplify(small, faces, share, aggressiveness)
    for cells in (64, 48, 32, 24, 16):
        if len(faces) > ENOUGH * wanted:
            small, faces = snap(small, faces, cells)
    return small, faces


def snap(vertices: Array, triangles: Array, cells: int) -> tuple[Array, Array]:
    """One vertex for each cell of a grid with ``cells`` along the longest side, and the triangles
    that are left. For a mesh of hundreds of loose pieces, which cannot collapse any further."""
    edge = np.ptp(vertices, axis=0).max() / cells
    cell = np.floor((vertices - vertices.min(0)) / edge).astype(np.int64)
    key = (cell[:, 0] * (cells + 1) + cell[:, 1]) * (cells + 1) + cell[:, 2]
    _, first, place = np.unique(key, return_index=True, return_inverse=True)
    faces = place.reshape(-1)[triangles]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    low, middle, high = np.sort(faces, axis=1).astype(np.int64).T
    _, distinct = np.unique((low * len(first) + middle) * len(first) + high, return_index=True)
    return vertices[first], faces[np.sort(distinct)].astype(np.int32)
