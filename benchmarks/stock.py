"""Tasks drawn as their simulators' users draw them, to be measured against.

Same task, same size, cameras at the same places; colour only, where ours reads colour and depth.
Meta-World is drawn by ``mujoco.Renderer`` under the model's own flags, ManiSkill by the task's own
sensors under its own settings.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.types import Array, CameraSpec

MODEL_CAMERAS = {"first": "gripperPOV", "third_a": "corner2", "third_b": "corner3"}
"""The cameras of Meta-World's own model that are moved to our places."""


def stock_frames(task: str, size: int) -> MetaWorldStock | ManiSkillStock:
    """``task`` of Meta-World or ManiSkill, drawn in ``size`` pixels."""
    suite, name = task.split("/")
    return STOCK_SUITES[suite](name, size)


class MetaWorldStock:
    """A task and its stock renderer. Belongs to the thread that makes it, as OpenGL contexts do."""

    def __init__(self, task: str, size: int) -> None:
        # These load an OpenGL library: ours must have checked it before.
        import mujoco
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

        from madviz.envs.metaworld.environment import CAMERAS

        build: Any = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"]
        self._simulation = build(seed=0)
        model = self._simulation.model
        for camera in CAMERAS:
            if camera.body is None:
                model.camera(MODEL_CAMERAS[camera.name]).pos[:] = camera.position
        self._simulation.reset()
        self._renderer = mujoco.Renderer(model, size, size)
        self._flags = mujoco.mjtRndFlag

    def step(self) -> None:
        *_, over, _ = self._simulation.step(np.zeros(4, np.float32))
        if over:  # It refuses a step after its last one.
            self._simulation.reset()

    def draw(self) -> list[Array]:
        """One (H, W, 3) uint8 picture of each camera, as it comes out of the frame buffer."""
        pictures = []
        for camera in MODEL_CAMERAS.values():
            self._renderer.update_scene(self._simulation.data, camera)
            pictures.append(self._renderer.render().copy())
        return pictures

    def flags(self) -> str:
        """The settings that cost, read from the model and the scene."""
        quality = self._simulation.model.vis.quality
        on = self._renderer.scene.flags
        return (
            f"shadows {on[self._flags.mjRND_SHADOW.value]} ({quality.shadowsize}), "
            f"reflections {on[self._flags.mjRND_REFLECTION.value]}, {quality.offsamples} samples"
        )

    def close(self) -> None:
        self._renderer.close()


class ManiSkillStock:
    """A task and its stock sensors. Belongs to the thread that makes it."""

    def __init__(self, task: str, size: int) -> None:
        from madviz.envs.maniskill.tasks import build

        class PaperSensors(_PaperSensors):
            madviz_task = task

        self._simulation = build(
            task,
            PaperSensors,
            obs_mode="rgb",
            render_backend="cpu",
            sensor_configs={"width": size, "height": size},
        )
        self._simulation.reset(seed=0)

    def step(self) -> None:
        """Physics alone: what a step does before it asks for observations."""
        self._simulation._step_action(np.zeros(4, np.float32))

    def draw(self) -> list[Array]:
        """One (H, W, 3) uint8 picture of each sensor, through ManiSkill's own observation code."""
        seen = self._simulation._get_obs_sensor_data()
        return [np.asarray(sensor["rgb"][0]) for sensor in seen.values()]

    def flags(self) -> str:
        """The settings that cost, read from the scene."""
        import sapien.render

        count = 0
        for entity in self._simulation.scene.sub_scenes[0].entities:
            body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
            for shape in body.render_shapes if body else ():
                count += sum(len(part.triangles) for part in getattr(shape, "parts", ()))
        return f"shadows {int(self._simulation.enable_shadow)}, {count} triangles"

    def close(self) -> None:
        self._simulation.close()


class _PaperSensors:
    """Goes before a stock task: the paper's standing cameras in place of the task's own sensor. The
    wrist camera is the robot's."""

    madviz_task: str

    @property
    def _default_sensor_configs(self) -> list[Any]:
        from madviz.envs.maniskill.environment import cameras_of

        return [_sensor(camera) for camera in cameras_of(self.madviz_task) if camera.body is None]


def _sensor(camera: CameraSpec) -> Any:
    """``camera`` as one of ManiSkill's own sensors."""
    import sapien
    from mani_skill.sensors.camera import CameraConfig
    from mani_skill.utils.structs.pose import Pose

    from madviz.envs.maniskill.render import FAR, NEAR, sapien_pose

    return CameraConfig(
        uid=camera.name,
        pose=Pose.create(sapien.Pose(sapien_pose(camera.position, camera.wxyz))),
        width=camera.size,
        height=camera.size,
        fov=float(np.radians(camera.fovy)),
        near=NEAR,
        far=FAR,
    )


STOCK_SUITES = {"metaworld": MetaWorldStock, "maniskill": ManiSkillStock}
