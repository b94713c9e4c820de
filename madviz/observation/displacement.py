"""A camera that stands elsewhere than in training: by how far, and where that is.

The problem: somebody bumps into a camera, and nobody puts it back to the millimetre. How far may it
go before a policy notices? To ask that, a move needs numbers that mean the same for every camera.

The idea: they count along the camera's own axes, as it stood in training, not along the world's.
Forward is into its picture, right and up are the picture's right and up. So a visitor sees in the
picture what a number did, a camera that rides on the hand can be moved like any other, and no
suite's choice of world axes matters. A camera at (0, 0, 2) that looks straight down, moved 0.1
forward and 0.2 to the right, stands at (0.2, 0, 1.9).

A camera goes first and turns then, about where it has come to. Zoom enlarges the picture: 2 shows
half as much of the scene across, which for a field of view of 60 degrees leaves 32.2.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.errors import UserError
from madviz.types import Array, CameraPose, CameraSpec

LARGEST = {
    **dict.fromkeys(("forward", "right", "up"), 1.0),
    **dict.fromkeys(("pan", "tilt"), 90.0),
}
"""Metres and degrees, either way."""
MOST_ZOOM = 2.0
"""The picture is enlarged at most that much, or shrunk."""
HALF_TURN = Rotation.from_euler("x", np.pi)
"""Between OpenGL axes (y up, looking along -z) and OpenCV axes (y down, looking along +z)."""
NARROWEST = 5.0
WIDEST = 150.0
"""Degrees of a field of view that environments draw."""
_WORDS = {
    "forward": ("forward", "back", " m"),
    "right": ("to the right", "to the left", " m"),
    "up": ("up", "down", " m"),
    "pan": ("turned right", "turned left", "°"),
    "tilt": ("turned up", "turned down", "°"),
}


@dataclass(frozen=True)
class Displacement:
    """How far a camera is from where its policy was trained; see the module for the axes."""

    forward: float = 0.0
    """Metres into the picture."""
    right: float = 0.0
    up: float = 0.0
    pan: float = 0.0
    """Degrees that it turns to the right."""
    tilt: float = 0.0
    """Degrees that it turns up."""
    zoom: float = 1.0
    """How much larger things in the middle of the picture are."""

    def __post_init__(self) -> None:
        for name, most in LARGEST.items():
            _check(name, getattr(self, name), -most, most)
        _check("zoom", self.zoom, 1 / MOST_ZOOM, MOST_ZOOM)

    @property
    def is_none(self) -> bool:
        """Whether the camera stands where it did."""
        return self == Displacement()

    @property
    def turn(self) -> Rotation:
        """From the camera's axes in training to those it has now."""
        return Rotation.from_euler("YX", [-self.pan, self.tilt], degrees=True)

    def placed(self, camera: CameraSpec) -> CameraSpec:
        """Where ``camera``, as its policy was trained with it, stands when it is moved."""
        before = Rotation.from_quat(camera.wxyz, scalar_first=True)
        shift = before.apply([self.right, self.up, -self.forward])
        x, y, z = (np.asarray(camera.position, float) + shift).tolist()
        w, i, j, k = (before * self.turn).as_quat(scalar_first=True).tolist()
        half = math.tan(math.radians(camera.fovy) / 2) / self.zoom
        fovy = min(max(2 * math.degrees(math.atan(half)), NARROWEST), WIDEST)
        return replace(camera, position=(x, y, z), wxyz=(w, i, j, k), fovy=fovy)

    @property
    def changed(self) -> dict[str, float]:
        """The fields that say where it went."""
        plain = asdict(Displacement())
        return {name: value for name, value in asdict(self).items() if value != plain[name]}

    def key(self) -> str:
        """For a name: ``moved,right=0.1``."""
        return "moved" + "".join(f",{name}={value:g}" for name, value in self.changed.items())

    def words(self) -> str:
        """``0.10 m to the right, turned left 5°``."""
        parts = []
        for name, (ahead, back, unit) in _WORDS.items():
            value = getattr(self, name)
            size = f"{abs(value):.2f}{unit}" if unit == " m" else f"{abs(value):g}{unit}"
            if value:
                word = ahead if value > 0 else back
                parts.append(f"{word} {size}" if unit == "°" else f"{size} {word}")
        if self.zoom != 1:
            parts.append(f"zoomed {'in' if self.zoom > 1 else 'out'} to {self.zoom:.2f}")
        return ", ".join(parts) or "in its place"


Moves = tuple[tuple[str, Displacement], ...]
"""By camera, in a fixed order."""


@dataclass(frozen=True)
class MoveCamera:
    """A command: a camera stands elsewhere from now on; None puts it back where it was trained."""

    camera: str
    move: Displacement | None


def trained_axes(pose: CameraPose, move: Displacement) -> Rotation:
    """OpenGL axes in the world that a camera had in training, which is at ``pose`` by ``move``."""
    return Rotation.from_quat(pose.wxyz, scalar_first=True) * HALF_TURN * move.turn.inv()


def moved_on(pose: CameraPose, before: Displacement, after: Displacement) -> CameraPose:
    """Where a camera that is at ``pose`` by ``before`` stands and looks by ``after``."""
    axes = trained_axes(pose, before)
    right, up, ahead = (
        getattr(after, name) - getattr(before, name) for name in ("right", "up", "forward")
    )
    place = np.asarray(pose.position, float) + axes.apply([right, up, -ahead])
    wxyz = (axes * after.turn * HALF_TURN).as_quat(scalar_first=True)
    return replace(pose, position=place, wxyz=wxyz)


def dragged(pose: CameraPose, move: Displacement, place: Array) -> Displacement:
    """``move`` with the camera at ``place`` (3,), metres in the world, instead of at ``pose``; it
    turns and zooms as before, and goes no further than LARGEST, by whole centimetres."""
    axes = trained_axes(pose, move)
    way = axes.inv().apply(np.asarray(place, float) - np.asarray(pose.position, float))
    right, up, back = way + [move.right, move.up, -move.forward]
    asked = {"forward": -back, "right": right, "up": up}
    if not np.isfinite(way).all():
        raise UserError(f"expected a place for a camera, found {place}; drag it again")
    most = LARGEST["forward"]
    goes = {name: round(min(max(value, -most), most), 2) + 0.0 for name, value in asked.items()}
    return replace(move, **goes)


def turned(pose: CameraPose, move: Displacement, wxyz: Array) -> Displacement:
    """``move`` with the camera, which is at ``pose`` by it, turned to look as ``wxyz`` (4,) says,
    in OpenCV axes as ``pose`` has them: by whole degrees, no further than LARGEST. A picture that
    would lie on its side stays upright: with R = pan and tilt, R (0, 0, -1) is

        (cos tilt sin pan, sin tilt, -cos tilt cos pan)
    """
    ahead = Rotation.from_quat(wxyz, scalar_first=True).apply([0.0, 0.0, 1.0])
    x, y, z = trained_axes(pose, move).inv().apply(ahead).tolist()
    level = math.hypot(x, z)
    # Straight up or down is no direction to pan to.
    pan = math.degrees(math.atan2(x, -z)) if level > 1e-3 else move.pan
    tilt = math.degrees(math.atan2(y, level))
    most = LARGEST["pan"]
    pan, tilt = (round(min(max(angle, -most), most)) + 0.0 for angle in (pan, tilt))
    return replace(move, pan=pan, tilt=tilt)


def _check(name: str, value: object, low: float, high: float) -> None:
    # NaN is in no range.
    if isinstance(value, bool) or not (isinstance(value, int | float) and low <= value <= high):
        raise UserError(
            f"expected {name} of a moved camera from {low:g} to {high:g}, found {value!r}; "
            "choose one between"
        )
