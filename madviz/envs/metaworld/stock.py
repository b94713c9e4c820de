"""Meta-World drawn as its users draw it: ``mujoco.Renderer`` under the model's own flags.

It is here to be measured against, see ``benchmarks render``. Same task, same size, the model's
own cameras moved to the same places; colour only, where ours reads colour and depth.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

from madviz.envs.metaworld.environment import CAMERAS
from madviz.types import Array

MODEL_CAMERAS = {"first": "gripperPOV", "third_a": "corner2", "third_b": "corner3"}


class MetaWorldStock:
    """A task and its stock renderer. Belongs to the thread that makes it, as OpenGL contexts do."""

    def __init__(self, task: str, size: int) -> None:
        build: Any = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"]
        self._simulation = build(seed=0)
        model = self._simulation.model
        for camera in CAMERAS:
            if camera.body is None:
                model.camera(MODEL_CAMERAS[camera.name]).pos[:] = camera.position
        self._simulation.reset()
        self._renderer = mujoco.Renderer(model, size, size)

    def step(self) -> None:
        self._simulation.step(np.zeros(4, np.float32))

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
        shadow = mujoco.mjtRndFlag.mjRND_SHADOW
        reflection = mujoco.mjtRndFlag.mjRND_REFLECTION
        return (
            f"shadows {on[shadow.value]} ({quality.shadowsize}), "
            f"reflections {on[reflection.value]}, {quality.offsamples} samples"
        )

    def close(self) -> None:
        self._renderer.close()
