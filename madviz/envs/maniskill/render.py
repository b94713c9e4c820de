"""Drawing a ManiSkill scene one camera at a time: colour and metric depth in one pass.

What is drawn is a second copy of the task, built once, whose joints and objects are set to where
the physics has them. So the physics can be built anew for every episode (see ``tasks.py``)
without loading a mesh, and a simulation that is never looked at loads none at all.

Cameras are free and placed by pose before every picture; each camera and size has one component.
ManiSkill's own sensors would all be drawn in every step, which a page that answers between two
pictures cannot use. The shader pack is ManiSkill's default for observations, ``minimal``, less a
table that nothing here needs (``shaders.py``): no shadows, 8-bit colour, and positions in whole
millimetres that fit 16 bits. So depth has steps of 1 mm, ends at 32.8 m for the ground far away,
and reads 0 where nothing is; that becomes ``FAR``.

The profiles share all of this. ``fast`` draws lighter meshes, ``full`` the stock ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.envs.checks import check_size, largest_view
from madviz.envs.maniskill.meshes import light_files, lighten
from madviz.envs.maniskill.sapien_bodies import ManiSkillBodies
from madviz.envs.maniskill.shaders import STOCK, shader_pack
from madviz.envs.maniskill.tasks import build
from madviz.types import Array, View

NEAR = 0.01
FAR = 100.0
"""Metres."""


class DrawnCopy:
    """The copy of one task that is drawn. Belongs to the thread that makes it."""

    def __init__(self, task: str, render_profile: str) -> None:
        self._largest = largest_view(render_profile)
        with light_files() if render_profile == "fast" else nullcontext():
            self._copy: Any = build(task, render_backend="cpu")
        self._scene: Any = self._copy.scene.sub_scenes[0]
        for hidden in self._copy._hidden_objects:  # PickCube's goal is not for policies to see.
            hidden.hide_visual()
        if render_profile == "fast":
            lighten(self._scene)
        self._cameras: dict[tuple[str, int], tuple[Any, Any]] = {}
        self._bodies: ManiSkillBodies | None = None

    @property
    def bodies(self) -> ManiSkillBodies:
        """The drawn bodies, as meshes for somebody else to draw; made when first asked for."""
        if self._bodies is None:
            self._bodies = ManiSkillBodies(self._scene)
        return self._bodies

    def follow(self, simulation: Any) -> None:
        """Puts joints and objects where ``simulation``, another copy of the task, has them."""
        self._copy.agent.robot.set_qpos(simulation.agent.robot.get_qpos())
        for name, actor in simulation.scene.actors.items():
            if actor.px_body_type != "static":
                self._copy.scene.actors[name]._objs[0].pose = actor._objs[0].pose

    def draw(self, name: str, position: Array, wxyz: Array, fovy: float, size: int) -> View:
        """The view from ``position`` (3,) metres; ``wxyz`` (4,) has OpenGL camera axes; ``fovy`` in
        degrees; square of ``size`` pixels. ``name`` says which camera it is, so that its buffers
        are made once. Raises UserError for a size that cannot be drawn."""
        import sapien

        check_size(size, self._largest)
        if (name, size) not in self._cameras:
            self._cameras[name, size] = self._camera(size)
        entity, camera = self._cameras[name, size]
        camera.set_fovy(np.radians(fovy), compute_x=True)
        entity.pose = sapien.Pose(sapien_pose(position, wxyz))
        self._scene.update_render()  # Tells the renderer where everything is, the camera too.
        camera.take_picture()
        colour = camera.get_picture("Color")
        place = camera.get_picture("PositionSegmentation")
        millimetres = -place[..., 2].astype(np.float32)
        depth = np.where(millimetres > 0, millimetres / 1000, np.float32(FAR))
        return View(np.ascontiguousarray(colour[..., :3]), depth)

    def close(self) -> None:
        """Lets go of the scene, and its memory with it."""
        self._cameras.clear()
        self._scene = self._copy = self._bodies = None

    def _camera(self, size: int) -> tuple[Any, Any]:
        import sapien
        from mani_skill.render import PREBUILT_SHADER_CONFIGS, set_shader_pack

        # What cameras made next will draw with: its picture formats, then our copy of its shaders.
        set_shader_pack(PREBUILT_SHADER_CONFIGS[STOCK])
        sapien.render.set_camera_shader_dir(shader_pack(self._scene))
        camera = sapien.render.RenderCameraComponent(size, size)
        camera.near = NEAR
        camera.far = FAR
        entity = sapien.Entity()
        entity.add_component(camera)
        self._scene.add_entity(entity)
        return entity, camera


def sapien_pose(position: Sequence[float] | Array, wxyz: Sequence[float] | Array) -> Array:
    """(4, 4) of a camera with OpenGL axes as SAPIEN describes it: looking along x, y to the left, z
    up."""
    axes = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = np.stack([-axes[:, 2], -axes[:, 0], axes[:, 1]], axis=1)
    matrix[:3, 3] = position
    return matrix
