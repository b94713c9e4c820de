"""ManiSkill3 as the paper uses it: five tasks, three cameras, 50 decisions, no early end.

``first`` is the Panda's wrist camera. Unlike Meta-World's it turns with the hand; the paper rotates
its pictures by 90 degrees, so that the far side of the table is up, and here the camera itself is
rolled. ``third_a`` and ``third_b`` stand beside the table. Where they stand was published for
pick-cube and poke-cube; the other tasks take pick-cube's, which is the likely choice.

An action moves the tool point by up to 0.1 m along x, y, z and opens or closes the gripper. The
reward is ManiSkill's normalised dense one, at most 1 a decision. Success does not end an episode:
whoever finishes early has to stay there. The state, and what in it is privileged, is described in
``tasks.py``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.envs.cameras import look_at, standing_camera
from madviz.envs.checks import check_action
from madviz.envs.maniskill.experts import expert_action
from madviz.envs.maniskill.tasks import PLACES, STATE_DIM, build, places, position, states
from madviz.envs.maniskill.vulkan import renderer
from madviz.envs.placement import PlacedCameras, drawn_cameras
from madviz.envs.tasks import INSTRUCTIONS, MANISKILL_SUCCESS
from madviz.state_numbers import StateNumbers
from madviz.types import Array, Body, CameraSpec, EnvSpec, TimeStep, View

HORIZON = 50


CAMERAS = (
    CameraSpec(
        "first",
        "First person",
        fovy=90,
        wxyz=(0.0, 0.70711, 0.0, -0.70711),
        body="camera_link",
        depth_range=(0.0, 0.5),
    ),
    standing_camera("third_a", "Third A", 57.29578, (0.6, 0.7, 0.6), (0.0, 0.0, 0.35), (0.4, 1.8)),
    standing_camera("third_b", "Third B", 45, (0.0, -0.9, 0.6), (0.0, 0.0, 0.15), (0.5, 1.6)),
)
"""The paper's cameras. One on a body has position and orientation in that body's frame."""

_FIRST, _THIRD_A, _THIRD_B = CAMERAS
_POKE_A = replace(_THIRD_A, wxyz=look_at((0.6, 0.7, 0.6), (0.2, 0.2, 0.35)))

SETTING_CAMERAS: dict[str, tuple[CameraSpec, ...]] = {
    "five": (
        standing_camera("third_c", "Third C", 50, (0.1, 0.95, 0.55), (0.0, 0.0, 0.1), (0.5, 1.7)),
        standing_camera("top", "Top", 50, (0.45, 0.0, 1.1), (0.0, 0.0, 0.05), (0.6, 1.4)),
    ),
    "turned-away": (
        replace(_FIRST, wxyz=look_at((0, 0, 0), (-0.87, 0.0, 0.5))),
        replace(_THIRD_B, wxyz=look_at((0, 0, 0), (0.0, -0.9, 0.5))),
    ),
}
"""By setting, the cameras added or moved. ``third_c`` looks across the table from the side opposite
Third B, ``top`` down on it from its near edge. In ``turned-away`` First looks up past the arm
and Third B up and away from the table (the paper says "uninformative directions" and gives none).
"""


def cameras_of(task: str) -> tuple[CameraSpec, ...]:
    """The three cameras of ``task``: poke-cube's ``third_a`` looks at another place."""
    return (_FIRST, _POKE_A, _THIRD_B) if task == "poke-cube" else CAMERAS


class ManiSkill(PlacedCameras):
    """One task, a ``madviz.types.Environment``. Only the thread that makes it may use it.

    ``simulation`` is ManiSkill's own environment, physics only.
    """

    setting_cameras = SETTING_CAMERAS

    @staticmethod
    def describe(task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> EnvSpec:
        """The facts of ``task``, without a simulator."""
        pose = 18 + (task in STATE_DIM)  # After joints, their speeds, and whether it grasps.
        return EnvSpec(
            f"maniskill/{task}",
            drawn_cameras(cameras_of(task), cameras),
            state_dim=STATE_DIM.get(task, 28),
            action_dim=4,
            state_numbers=StateNumbers(
                start=(25, 26, 27) if task in ("push-cube", "pull-cube") else (),
                angles=(*range(7), *range(9, 16)),  # Joints, and their speeds; no fingers.
                robot=(*range(9), *range(pose, pose + 7)),
            ),
            gripper="closes at -1",
            horizon=HORIZON,
            render_profile=render_profile,
            success=MANISKILL_SUCCESS[task],
            instruction=INSTRUCTIONS[f"maniskill/{task}"],
        )

    def __init__(
        self, task: str, render_profile: str = "fast", cameras: tuple[CameraSpec, ...] = ()
    ) -> None:
        """``cameras`` as in ``make_env``. Raises UserError where SAPIEN finds no Vulkan that it can
        draw with, and for a camera on a body that is not there."""
        renderer()
        spec = self.describe(task, render_profile, cameras)
        self._task = task
        self.simulation = build(task)
        super().__init__(spec, list(self.simulation.agent.robot.links_map))
        self._step = 0
        self._stale = True
        self._copy: Any = None  # Made on the first view: many uses never draw.

    def reset(self, seed: int) -> TimeStep:
        self.simulation.reset(seed=seed, options={"reconfigure": True})
        self._step = 0
        self._stale = True
        info = self.simulation.evaluate()
        return TimeStep(self._state(info), 0.0, bool(info["success"][0]), last=False)

    def step(self, action: Array) -> TimeStep:
        check_action(action, self.spec.action_dim)
        clipped = np.clip(np.asarray(action, np.float32), -1, 1)
        _, reward, _, _, info = self.simulation.step(clipped)
        self._step = self._step + 1
        self._stale = True
        success = bool(info["success"][0])
        last = self._step >= HORIZON
        return TimeStep(self._state(info), float(reward[0]), success, last)

    def view(self, camera: str, size: int | None = None) -> View:
        spec = self.placed(camera)
        place, rotation = self.in_world(spec)
        wxyz = rotation.as_quat(scalar_first=True)
        return self._drawn().draw(camera, place, wxyz, spec.fovy, size or spec.size)

    def in_world(self, camera: CameraSpec) -> tuple[Array, Rotation]:
        place = np.asarray(camera.position, float)
        rotation = Rotation.from_quat(camera.wxyz, scalar_first=True)
        if camera.body is None:
            return place, rotation
        body = self.simulation.agent.robot.links_map[camera.body].pose.sp
        turned = Rotation.from_quat(body.q, scalar_first=True)
        return turned.apply(place) + body.p, turned * rotation

    def bodies(self) -> tuple[Body, ...]:
        return self._drawn().bodies.bodies

    def body_poses(self) -> Array:
        return self._drawn().bodies.poses()

    def hand(self) -> Array:
        return position(self.simulation.agent.tcp).astype(np.float32)

    @property
    def place_names(self) -> tuple[str, ...]:
        """(P,) ManiSkill's own names of ``places``, in their order."""
        return PLACES[self._task]

    def places(self) -> Array:
        return places(self._task, self.simulation)

    def expert(self) -> Array:
        return expert_action(self._task, self.simulation)

    def close(self) -> None:
        if self._copy is not None:
            self._copy.close()
            self._copy = None

    def _drawn(self) -> Any:
        """The copy that is drawn, with everything where the physics has it."""
        if self._copy is None:
            from madviz.envs.maniskill.render import DrawnCopy

            self._copy = DrawnCopy(self._task, self.spec.render_profile)
        if self._stale:
            self._copy.follow(self.simulation)
            self._stale = False
        return self._copy

    def _state(self, info: dict[str, Any]) -> Array:
        return states(self._task, self.simulation, info)[0]
