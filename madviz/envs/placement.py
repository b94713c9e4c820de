"""Where an environment's cameras are now: as its spec says, but for those somebody has moved.

The spec does not change when a camera moves: it says where the policy was trained, and where to put
the camera back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.errors import UserError, unknown
from madviz.types import Array, CameraPose, CameraSpec, EnvSpec


def drawn_cameras(
    own: tuple[CameraSpec, ...], given: tuple[CameraSpec, ...]
) -> tuple[CameraSpec, ...]:
    """What an environment draws: its ``own`` cameras where ``given`` is empty; with ``given`` ones
    in their places where all of them bear names of its own; otherwise ``given`` and no others."""
    named = {camera.name: camera for camera in given}
    if named.keys() <= {camera.name for camera in own}:
        return tuple(named.get(camera.name, camera) for camera in own)
    return given


def camera_pose(position: Array, rotation: Rotation, fovy: float) -> CameraPose:
    """Of a camera at ``position`` (3,) metres, whose ``rotation`` has OpenGL axes."""
    turned = rotation * Rotation.from_euler("x", np.pi)  # OpenCV's: half a turn about x.
    return CameraPose(position, turned.as_quat(scalar_first=True), fovy)


class Placements:
    """The moved cameras of one environment."""

    def __init__(self, bodies: Sequence[str]) -> None:
        """``bodies`` are those that a camera can ride on."""
        self._bodies = tuple(bodies)
        self._moved: dict[str, CameraSpec] = {}

    def check(self, camera: CameraSpec) -> None:
        """Raises UserError for a camera on a body that is not there."""
        if camera.body is not None and camera.body not in self._bodies:
            raise unknown(f"body of the camera {camera.name}", camera.body, list(self._bodies))

    def move(self, spec: EnvSpec, camera: str, to: CameraSpec | None) -> None:
        """See ``Environment.move_camera``."""
        own = spec.camera(camera)
        if to is None:
            self._moved.pop(camera, None)
            return
        numbers = np.array([*to.position, *to.wxyz, to.fovy], float)
        if not np.isfinite(numbers).all() or not 0.5 < np.linalg.norm(to.wxyz) < 2:
            raise UserError(
                f"expected a place and an orientation for the camera {camera}, found "
                f"{to.position} and {to.wxyz}; give three metres and a unit quaternion"
            )
        if not 5 <= to.fovy <= 150:
            raise UserError(
                f"expected a field of view of 5 to 150 degrees for the camera {camera}, found "
                f"{to.fovy:g}; choose one between"
            )
        placed = replace(own, position=to.position, wxyz=to.wxyz, fovy=to.fovy, body=to.body)
        self.check(placed)
        self._moved[camera] = placed

    def moved(self, camera: str) -> bool:
        """Whether ``camera`` stands elsewhere than in the spec."""
        return camera in self._moved

    def of(self, spec: EnvSpec, camera: str) -> CameraSpec:
        """The camera as it stands now. Raises UserError naming the known ones."""
        own = spec.camera(camera)
        return self._moved.get(camera, own)
