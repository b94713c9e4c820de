"""Cameras from a user's own file: places to look from, and how each is drawn.

    [[camera]]
    name = "left"                    # what subsets and streams call it
    label = "Left"                   # what the page calls it; by default made from the name
    position = [-0.7, 0.3, 0.6]      # metres, in the world, or relative to ``body``
    look_at = [0.0, 0.7, 0.1]        # a point in the same frame; or instead of it ``wxyz``
    fovy = 55                        # vertical field of view, degrees
    size = 96                        # rows and columns drawn; policies get 84 of each
    body = "hand"                    # optional: follow this body's position
    depth_range = [0.3, 1.8]         # optional: metres that are coded 0 and 255

``wxyz`` is the orientation in the world of OpenGL camera axes (x right, y up, looking along -z),
as in ``madviz.types.CameraSpec``. A file stands for itself: its cameras are all there are, unless
each bears the name of one of the suite's own and merely takes its place.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct
from scipy.spatial.transform import Rotation

from madviz.errors import UserError
from madviz.system.files import read_toml
from madviz.system.typed import typed
from madviz.types import CameraSpec

RESERVED = ("all", "none", "rgb", "depth")
"""Words that already name subsets."""
MOST = 8
"""Cameras in a file: every subset of the streams is read at every step, and there are 2^V."""

Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
"""Any but NaN and infinity."""
Position = tuple[Number, Number, Number]


class CameraTable(Struct, forbid_unknown_fields=True):
    """One [[camera]] of a file."""

    name: str
    position: Position
    label: str = ""
    wxyz: tuple[Number, Number, Number, Number] | None = None
    look_at: Position | None = None
    fovy: Annotated[float, Meta(ge=5, le=150)] = 60.0
    size: Annotated[int, Meta(ge=16, le=512)] = 84
    body: str | None = None
    depth_range: tuple[Number, Number] = (0.0, 2.0)

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,23}", self.name):
            raise ValueError(
                f"expected a name of small letters, digits and _, found {self.name!r:.40}"
            )
        if self.name in RESERVED:
            raise ValueError(f"expected another name than {self.name!r}, which is a subset's")
        near, far = self.depth_range
        if not 0 <= near < far:
            raise ValueError(
                "expected depth_range = [near, far] in metres, 0 <= near < far, found "
                f"{[near, far]}"
            )
        if (self.wxyz is None) == (self.look_at is None):
            found = "neither" if self.wxyz is None else "both"
            raise ValueError(f"expected either wxyz or look_at, found {found}")
        if self.wxyz and not 0.9 < (norm := math.hypot(*self.wxyz)) < 1.1:
            raise ValueError(
                f"expected wxyz of norm 1, its scalar part first, found norm {norm:.2f}"
            )
        if self.look_at and math.dist(self.look_at, self.position) < 1e-9:
            raise ValueError(f"expected look_at apart from position, found both at {self.look_at}")

    def as_spec(self) -> CameraSpec:
        """The cameras that an environment draws."""
        if self.wxyz:
            w, x, y, z = (np.array(self.wxyz) / np.linalg.norm(self.wxyz)).tolist()
            turn = (w, x, y, z)
        else:
            turn = look_at(self.position, self.look_at or self.position)
        return CameraSpec(
            self.name,
            self.label.strip() or self.name.replace("_", " ").capitalize(),
            self.fovy,
            self.position,
            turn,
            self.body,
            self.depth_range,
            self.size,
        )


class CameraFile(Struct, forbid_unknown_fields=True):
    """A whole file; its tables are read one by one, so that a mistake names its camera."""

    camera: Annotated[list[dict[str, Any]], Meta(min_length=1, max_length=MOST)]


def look_at(
    position: tuple[float, ...], target: tuple[float, ...]
) -> tuple[float, float, float, float]:
    """wxyz of OpenGL camera axes at ``position`` (3,) that look at ``target`` (3,), z upwards.

    Where the view is straight up or down, the picture's upper edge points along +y.
    Raises ValueError if both are the same point.
    """
    forward = np.subtract(target, position).astype(float)
    if np.linalg.norm(forward) < 1e-9:
        raise ValueError("a camera cannot look at its own position")
    forward /= np.linalg.norm(forward)
    upright = abs(forward[2]) < 0.9999
    right = np.cross(forward, (0.0, 0.0, 1.0) if upright else (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), -forward], axis=1)
    w, x, y, z = Rotation.from_matrix(axes).as_quat(scalar_first=True).round(6).tolist()
    return (w, x, y, z)


def standing_camera(
    name: str,
    label: str,
    fovy: float,
    position: tuple[float, float, float],
    target: tuple[float, float, float],
    depth_range: tuple[float, float],
) -> CameraSpec:
    """A camera at ``position`` that looks at ``target``, both in metres; ``fovy`` in degrees."""
    turn = look_at(position, target)
    return CameraSpec(name, label, fovy, position, turn, depth_range=depth_range)


def read_cameras(path: str | Path) -> tuple[CameraSpec, ...]:
    """The cameras of a TOML file. Raises UserError, in one line, for anything amiss with it."""
    document = read_toml(Path(path), "a camera file", "fix it, or check --cameras")
    tables = typed(document, CameraFile, path, "write one [[camera]] table for each").camera
    cameras = []
    for number, table in enumerate(tables, 1):
        camera = typed(table, CameraTable, f"{path}, camera {number}", "fix it").as_spec()
        if camera.name in [other.name for other in cameras]:
            raise UserError(
                f"{path}: expected every name once, found two cameras {camera.name!r}; rename"
            )
        cameras.append(camera)
    return tuple(cameras)
