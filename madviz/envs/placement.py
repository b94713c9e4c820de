"""Where an environment's cameras are now: as its spec says, but for those somebody has moved.

The spec does not change when a camera moves: it says where the policy was trained, and where to put
the camera back.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.errors import UserError, unknown
from madviz.types import Array, CameraPose, CameraSpec, EnvSpec


def drawn_cameras(
    own: tuple[CameraSpec, ...], given: tuple[CameraSpec, ...]
) -> tuple[CameraSpec, ...]:
    """The cameras that an environment draws: its ``own`` cameras where ``given`` is empty; with
    ``given`` ones in their places where all of them bear names of its own; otherwise ``given`` and
    no others."""
    named = {camera.name: camera for camera in given}
    if named.keys() <= {camera.name for camera in own}:
        return tuple(named.get(camera.name, camera) for camera in own)
    return given


class PlacedCameras(ABC):
    """The cameras of an environment that draws from anywhere: the base of its class."""

    def __init__(self, spec: EnvSpec, bodies: Sequence[str]) -> None:
        """``bodies`` are those that a camera can ride on. Raises UserError for a camera of ``spec``
        on another."""
        self.spec = spec
        self._rideable = bodies
        self._moved: dict[str, CameraSpec] = {}
        for camera in spec.cameras:
            self._check_body(camera)

    @abstractmethod
    def in_world(self, camera: CameraSpec) -> tuple[Array, Rotation]:
        """Position (3,), metres, and orientation with OpenGL axes, both in the world."""

    def placed(self, camera: str) -> CameraSpec:
        """The camera as it is now. Raises UserError for an unknown one."""
        own = self.spec.camera(camera)
        return self._moved.get(camera, own)

    def pose(self, camera: str) -> CameraPose:
        """Where one camera is now. Raises UserError for an unknown one."""
        placed = self.placed(camera)
        position, rotation = self.in_world(placed)
        turned = rotation * Rotation.from_euler("x", np.pi)  # OpenCV's axes: half a turn about x.
        return CameraPose(position, turned.as_quat(scalar_first=True), placed.fovy)

    def move_camera(self, camera: str, to: CameraSpec | None) -> None:
        """See ``madviz.types.Environment``."""
        own = self.spec.camera(camera)
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
        self._check_body(placed)
        self._moved[camera] = placed

    def _check_body(self, camera: CameraSpec) -> None:
        if camera.body is not None and camera.body not in self._rideable:
            raise unknown(f"body of the camera {camera.name}", camera.body, list(self._rideable))
