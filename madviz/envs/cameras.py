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
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.errors import UserError, unknown
from madviz.types import CameraSpec

KEYS = ("name", "label", "position", "wxyz", "look_at", "fovy", "size", "body", "depth_range")
RESERVED = ("all", "none", "rgb", "depth")
"""Words that already name subsets."""
MOST = 8
"""Cameras in a file: every subset of the streams is read at every step, and there are 2^V."""


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


def read_cameras(path: str | Path) -> tuple[CameraSpec, ...]:
    """The cameras of a TOML file. Raises UserError, in one line, for anything amiss with it."""
    try:
        document = tomllib.loads(Path(path).read_text())
    except OSError as error:
        raise UserError(
            f"{path}: expected a camera file, found none ({error.strerror}); check --cameras"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: expected TOML, found a mistake: {error}; mend it") from error
    tables = document.pop("camera", None)
    if document or not isinstance(tables, list) or not 1 <= len(tables) <= MOST:
        raise UserError(
            f"{path}: expected 1 to {MOST} [[camera]] tables and nothing else, found "
            f"{', '.join(document) or ('none' if not tables else f'{len(tables)} of them')}"
        )
    cameras = tuple(_camera(table, f"{path}, camera {i + 1}") for i, table in enumerate(tables))
    names = [camera.name for camera in cameras]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"{path}: expected every name once, found two cameras {name!r}; rename")
    return cameras


def _camera(table: Any, where: str) -> CameraSpec:
    if not isinstance(table, dict):
        raise UserError(f"{where}: expected a [[camera]] table, found {table!r:.40}")
    for key in table:
        if key not in KEYS:
            raise UserError(f"{where}: {unknown('key', key, list(KEYS))}")
    name = table.get("name")
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]{0,23}", name):
        raise UserError(
            f"{where}: expected a name of small letters, digits and _, found {name!r:.40}; "
            'write for example name = "left"'
        )
    if name in RESERVED:
        raise UserError(f"{where}: the name {name!r} is a subset's already; choose another")
    position = _numbers(table, "position", 3, where)
    near, far = _numbers(table, "depth_range", 2, where) if "depth_range" in table else (0.0, 2.0)
    if not 0 <= near < far:
        raise UserError(f"{where}: expected depth_range = [near, far] in metres, 0 <= near < far")
    body = table.get("body")
    return CameraSpec(
        name,
        _text(table.get("label", name.replace("_", " ").capitalize()), "label", where),
        fovy=_number(table.get("fovy", 60), "fovy", 5, 150, where),
        position=(position[0], position[1], position[2]),
        wxyz=_orientation(table, position, where),
        body=None if body is None else _text(body, "body", where),
        depth_range=(near, far),
        size=int(_number(table.get("size", 84), "size", 16, 512, where, whole=True)),
    )


def _orientation(
    table: dict[str, Any], position: tuple[float, ...], where: str
) -> tuple[float, float, float, float]:
    if ("wxyz" in table) == ("look_at" in table):
        found = "both" if "wxyz" in table else "neither"
        raise UserError(f"{where}: expected either wxyz or look_at, found {found}")
    if "look_at" in table:
        try:
            return look_at(position, _numbers(table, "look_at", 3, where))
        except ValueError as error:
            raise UserError(f"{where}: {error}; move look_at or position") from error
    wxyz = np.array(_numbers(table, "wxyz", 4, where))
    length = float(np.linalg.norm(wxyz))
    if not 0.9 < length < 1.1:
        raise UserError(
            f"{where}: expected wxyz of length 1, found {length:.2f}; the scalar part comes first"
        )
    w, x, y, z = (wxyz / length).tolist()
    return (w, x, y, z)


def _numbers(table: dict[str, Any], key: str, count: int, where: str) -> tuple[float, ...]:
    found = table.get(key)
    if not isinstance(found, list) or len(found) != count or not all(map(_finite, found)):
        raise UserError(
            f"{where}: expected {key} = [{count} numbers], found {_shown(table, key)}; mend it"
        )
    return tuple(float(number) for number in found)


def _number(
    found: Any, key: str, low: float, high: float, where: str, *, whole: bool = False
) -> float:
    if not _finite(found) or not low <= found <= high or (whole and not isinstance(found, int)):
        kind = "a whole number" if whole else "a number"
        raise UserError(
            f"{where}: expected {key}, {kind} from {low} to {high}, found {found!r:.40}"
        )
    return float(found)


def _text(found: Any, key: str, where: str) -> str:
    if not isinstance(found, str) or not found.strip():
        raise UserError(f"{where}: expected {key} to be a text, found {found!r:.40}")
    return found


def _finite(found: Any) -> bool:
    return isinstance(found, int | float) and not isinstance(found, bool) and math.isfinite(found)


def _shown(table: dict[str, Any], key: str) -> str:
    return f"{table[key]!r:.40}" if key in table else "none"
