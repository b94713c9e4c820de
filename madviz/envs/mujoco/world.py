"""What every task on MuJoCo shares: cameras that stand anywhere, and the scene as a page draws it.

The cameras of ``spec`` need not exist in the model: each is put into the scene by its pose when it
is drawn. A task adds what only it knows, ``reset``, ``step``, ``hand`` and ``expert``, and says
``moved()`` whenever its data have changed; ``madviz/examples/own_task.py`` is a whole one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.envs.mujoco.gl import check_gl
from madviz.envs.placement import Placements, camera_pose
from madviz.types import Array, Body, CameraPose, CameraSpec, EnvSpec, View


class MuJoCoWorld:
    """What draws in a ``madviz.types.Environment``. Only the thread that makes it may use it."""

    def __init__(self, spec: EnvSpec, model: Any, data: Any) -> None:
        """``model`` and ``data`` are MuJoCo's. Raises UserError where MuJoCo cannot draw, and for a
        camera on a body that is not there."""
        check_gl()
        self.spec = spec
        self._model, self._data = model, data
        self._placements = Placements([model.body(i).name for i in range(1, model.nbody)])
        for camera in spec.cameras:
            self._placements.check(camera)
        # Made when they are first asked for: many uses never draw.
        self._cameras: Any = None
        self._bodies: Any = None

    def moved(self) -> None:
        """Says that the data changed: the next view collects the scene again."""
        if self._cameras is not None:
            self._cameras.scene_changed()

    def view(self, camera: str, size: int | None = None) -> View:
        spec = self._placements.of(self.spec, camera)
        if self._cameras is None:
            # MuJoCo loads an OpenGL library while it is imported: not before ``check_gl``.
            from madviz.envs.mujoco.render import SceneCameras

            self._cameras = SceneCameras(self._model, self._data, self.spec.render_profile)
        rotation = Rotation.from_quat(spec.wxyz, scalar_first=True).as_matrix()
        return self._cameras.draw(self._position(spec), rotation, spec.fovy, size or spec.size)

    def pose(self, camera: str) -> CameraPose:
        spec = self._placements.of(self.spec, camera)
        rotation = Rotation.from_quat(spec.wxyz, scalar_first=True)
        return camera_pose(self._position(spec), rotation, spec.fovy)

    def move_camera(self, camera: str, to: CameraSpec | None) -> None:
        self._placements.move(self.spec, camera, to)

    def bodies(self) -> tuple[Body, ...]:
        return self._drawn_bodies().bodies

    def body_poses(self) -> Array:
        return self._drawn_bodies().poses(self._data)

    def close(self) -> None:
        if self._cameras is not None:
            self._cameras.close()
            self._cameras = None

    def _drawn_bodies(self) -> Any:
        if self._bodies is None:
            from madviz.envs.mujoco.bodies import MuJoCoBodies

            self._bodies = MuJoCoBodies(self._model, self._data)
        return self._bodies

    def _position(self, spec: CameraSpec) -> Array:
        origin = self._data.body(spec.body).xpos if spec.body else np.zeros(3)
        return np.asarray(origin) + np.asarray(spec.position)
