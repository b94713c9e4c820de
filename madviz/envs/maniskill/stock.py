"""ManiSkill drawn as its users draw it: the task's own sensors under its own settings.

It is here to be measured against, see ``benchmarks render --task maniskill/push-cube``. Same
task, same size, sensors at the same places; colour only, where ours reads colour and depth.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.envs.maniskill.environment import cameras_of
from madviz.envs.maniskill.tasks import build
from madviz.types import Array


class ManiSkillStock:
    """A task and its stock sensors. Belongs to the thread that makes it."""

    def __init__(self, task: str, size: int) -> None:
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
        return [np.asarray(each["rgb"][0]) for each in seen.values()]

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
        from madviz.envs.maniskill.render import sensor

        return [sensor(camera) for camera in cameras_of(self.madviz_task) if camera.body is None]
