"""Fewer triangles for the same shape: fast_simplification, one call at a time.

The library works in variables of its own. Two simulators that open at once, each in its visitor's
thread, would get each other's triangles, or none; the robot a policy sees would have holes.
"""

from __future__ import annotations

import threading
from typing import Any

import fast_simplification

from madviz.types import Array

_ONE_AT_A_TIME = threading.Lock()


def simplify(
    vertices: Array, triangles: Array, share: float, eagerness: float = 7.0
) -> tuple[Array, Array]:
    """Vertices (n, 3) and triangles (m, 3) of the same shape without about ``share`` of its
    triangles, by quadric error; ``eagerness`` is how soon the library takes an edge for flat."""
    call: Any = fast_simplification.simplify  # Its types say less than it takes.
    with _ONE_AT_A_TIME:
        small, faces, *_ = call(vertices, triangles, share, agg=eagerness)
    return small, faces
