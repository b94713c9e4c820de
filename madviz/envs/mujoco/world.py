"""Drawing for every task on MuJoCo: cameras that stand anywhere, and the scene for a page.

The cameras of ``spec`` need not exist in the model: each is put into the scene by its pose when it
is drawn. A task adds what only it knows, ``reset``, ``step``, ``hand`` and ``expert``, and says
``moved()`` whenever its data have changed; ``madviz/examples/own_task.py`` is a whole one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.envs.mujoco.gl import check_gl
from madviz.envs.placement import PlacedCameras
from madviz.types import Array, Body, CameraSpec, EnvSpec, View


class MuJoCoWorld(PlacedCameras):
    """The part of a ``madviz.types.Environment`` that draws. Only the thread that makes it may use
    it."""

    def __init__(self, spec: EnvSpec, model: Any, data: Any) -> None:
        """``model`` and ``data`` are MuJoCo's. Raises UserError where MuJoCo cannot draw, and for a
        camera on a body that is not there."""
        check_gl()
        super().__init__(spec, [model.body(i).name for i in range(1, model.nbody)])
        self._model = model
        self._data = data
        # Made when they are first asked for: many uses never draw.
        self._cameras: Any = None
        self._bodies: Any = None
        self._looks = b""
        """The colours, sizes and places in the model from which ``_bodies`` were made."""

    def moved(self) -> None:
        """Says that the data changed: the next view collects the scene again."""
        if self._cameras is not None:
            self._cameras.scene_changed()

    def view(self, camera: str, size: int | None = None) -> View:
        return self.view_from(self.placed(camera), size)

    def view_from(self, spec: CameraSpec, size: int | None = None) -> View:
        """Draws what a camera at the place of ``spec`` sees now."""
        if self._cameras is None:
            # MuJoCo loads an OpenGL library while it is imported: not before ``check_gl``.
            from madviz.envs.mujoco.render import SceneCameras

            self._cameras = SceneCameras(self._model, self._data, self.spec.render_profile)
        position, rotation = self.in_world(spec)
        return self._cameras.draw(position, rotation.as_matrix(), spec.fovy, size or spec.size)

    def in_world(self, camera: CameraSpec) -> tuple[Array, Rotation]:
        origin = self._data.body(camera.body).xpos if camera.body else np.zeros(3)
        position = np.asarray(origin) + np.asarray(camera.position)
        return position, Rotation.from_quat(camera.wxyz, scalar_first=True)

    def bodies(self) -> tuple[Body, ...]:
        return self._drawn_bodies().bodies

    def body_poses(self) -> Array:
        return self._drawn_bodies().poses(self._data)

    def close(self) -> None:
        if self._cameras is not None:
            self._cameras.close()
            self._cameras = None

    def _drawn_bodies(self) -> Any:
        model = self._model
        geoms = (model.geom_rgba, model.geom_size, model.geom_pos, model.geom_quat)
        others = (model.geom_matid, model.mat_rgba, model.site_rgba, model.site_size)
        looks = b"".join(numbers.tobytes() for numbers in (*geoms, *others))
        if self._bodies is None or looks != self._looks:
            from madviz.envs.mujoco.mujoco_bodies import MuJoCoBodies

            self._bodies = MuJoCoBodies(model, self._data)
            self._looks = looks
        return self._bodies
