"""Many copies of a ManiSkill task in one simulation, on a GPU: physics and pictures together.

The problem: a copy in a process of its own steps and draws on one core, 26 ms for three pictures,
and a machine has few cores. ManiSkill can step and draw L copies at once on a GPU, if they are one
simulation; then everything comes as arrays with a row for each:

    reset(seeds (L,))  ->  state (L, S)                       reset draws nothing
    step(actions (L, A)) -> state (L, S), reward (L,), success (L,), last
    draw() -> camera: colour (L, H, W, 3), depth (L, H, W)    all cameras of all copies

Cameras, success, state and the light meshes are those of ``ManiSkill``, whose pictures these are.
Two things are not as there. ManiSkill draws the scenes of all copies from the first seed, so a
scene is a function of all seeds and its place among them. And on a GPU a reset puts everything back
without building the physics of every copy anew, so an episode can differ a little
from the same one after another; a GPU's sums may differ too.

ManiSkill runs a single copy on a CPU through the same calls, and there this class is held to be
``ManiSkill``: equal numbers, pictures alike within a rounding (``tests/test_maniskill_batch.py``).
No machine with a GPU was at hand: WHAT ONLY A GPU RUNS HAS NEVER RUN, and none of its speed is
measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from madviz.envs.checks import check_action
from madviz.envs.maniskill.environment import HORIZON, cameras_of
from madviz.envs.maniskill.meshes import lighten
from madviz.envs.maniskill.render import FAR, sensor
from madviz.envs.maniskill.tasks import build, states
from madviz.envs.maniskill.vulkan import renderer
from madviz.envs.placement import drawn_cameras
from madviz.errors import UserError
from madviz.types import Array, CameraSpec, View


@dataclass(frozen=True)
class Steps:
    """What a reset or a step says of every copy."""

    state: Array
    """(L, S) float32."""
    reward: Array
    """(L,) float32; 0 after a reset."""
    success: Array
    """(L,) bool."""
    last: bool
    """Whether this was the last decision of an episode, which is as long for all."""


def claim_gpu() -> None:
    """Switches PhysX to GPUs for this process; before anything else simulates in it, or it is too
    late. Raises UserError where PyTorch finds no CUDA device."""
    if not torch.cuda.is_available():
        raise UserError(
            "expected a CUDA device to simulate ManiSkill on, found none that PyTorch can use; see "
            "`nvidia-smi`, or step environments in processes (--vectorised.simulation processes)"
        )
    from sapien import physx

    if not physx.is_gpu_enabled():
        physx.enable_gpu()


class ManiSkillBatch:
    """See the module. Not thread-safe, and bound to the thread that makes it."""

    def __init__(
        self,
        task: str,
        copies: int,
        render_profile: str = "fast",
        cameras: tuple[CameraSpec, ...] = (),
        device: Literal["cuda", "cpu"] = "cuda",
    ) -> None:
        """``task`` without its suite; ``cameras`` as in ``make_env``. On ``cpu`` one copy is
        possible. Raises UserError where there is no such device, or nothing to draw with."""
        if device == "cpu" and copies != 1:
            raise UserError(
                f"ManiSkill simulates one copy of a task on a CPU, found {copies}; step "
                "environments in processes (--vectorised.simulation processes)"
            )
        if device == "cuda":
            claim_gpu()
        else:
            renderer()
        self.cameras = drawn_cameras(cameras_of(task), cameras)
        self._task, self._device, self._step = task, device, 0
        light = render_profile == "fast"

        class OurCameras(_OurCameras):
            madviz_cameras, madviz_light = self.cameras, light

        self.simulation = build(
            task,
            OurCameras,
            num_envs=copies,
            obs_mode="rgb+depth",
            sim_backend=f"physx_{device}",
            render_backend="gpu" if device == "cuda" else "cpu",
        )

    def reset(self, seeds: list[int], rebuild: bool | None = None) -> Steps:
        """A new episode in every copy; ``seeds`` (L,). ``rebuild`` builds the physics anew, which
        PhysX needs to forget contacts (see ``tasks.py``): by default on a CPU, where it is cheap.
        """
        anew = self._device == "cpu" if rebuild is None else rebuild
        self.simulation.reset(seed=seeds, options={"reconfigure": anew})
        self._step = 0
        info = self.simulation.evaluate()
        return self._steps(info, torch.zeros(len(seeds)))

    def step(self, actions: Array) -> Steps:
        """``actions`` (L, A), clipped to -1 to 1. Raises UserError for others."""
        for action in actions:
            check_action(action, 4)
        chosen = torch.from_numpy(np.clip(actions, -1, 1).astype(np.float32)).to(self._device)
        _, reward, _, _, info = self.simulation.step(chosen)
        self._step += 1
        return self._steps(info, reward)

    def draw(self) -> dict[str, list[View]]:
        """By camera, every copy's view as it stands now."""
        # Hides what policies must not see, updates the renderer and waits for it.
        seen = self.simulation._get_obs_sensor_data()
        views = {}
        for name, textures in seen.items():
            colour = textures["rgb"].cpu().numpy()
            # Taken negative in 16 bits, the farthest that is drawn (32.768 m) stays negative.
            millimetres = textures["depth"][..., 0].cpu().numpy().astype(np.uint16)
            depth = np.where(millimetres, millimetres / np.float32(1000), np.float32(FAR))
            views[name] = [View(*pair) for pair in zip(colour, depth, strict=True)]
        return views

    def close(self) -> None:
        self.simulation.close()

    def _steps(self, info: dict[str, Any], reward: Any) -> Steps:
        state = states(self._task, self.simulation, info)
        success = info["success"].cpu().numpy()
        return Steps(state, reward.cpu().numpy(), success, self._step >= HORIZON)


class _OurCameras:
    """Goes before a stock task: sensors are our cameras and no others, heavy meshes go, and a step
    draws nothing that nobody asked for."""

    madviz_cameras: tuple[CameraSpec, ...]
    madviz_light: bool

    def get_obs(self, *_: Any, **__: Any) -> dict[str, Any]:
        return {}

    def _load_lighting(self, options: dict) -> None:
        """The last that is loaded before a GPU's buffers are made."""
        self.scene: Any
        super()._load_lighting(options)  # type: ignore[misc]
        if self.madviz_light:
            for scene in self.scene.sub_scenes:
                lighten(scene)

    def _setup_sensors(self, options: dict) -> None:
        from mani_skill.sensors.camera import Camera

        self.agent: Any
        links = self.agent.robot.links_map
        self._human_render_cameras = self.scene.human_render_cameras = {}
        self._sensors = self.scene.sensors = {
            each.name: Camera(sensor(each, each.body and links[each.body]), self.scene)
            for each in self.madviz_cameras
        }
