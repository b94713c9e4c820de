"""``recording/NAME``: recordings of a robot, as an environment whose robot does not listen.

Open loop: an episode goes on as it was recorded, whatever the action. There is no simulator, so
there is no success, reward, scene or depth; the expert is the person or program that was recorded.
States and actions are scaled by the statistics of the episodes for training (``Recordings``).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from madviz.envs.checks import check_action, check_size, resized_cameras
from madviz.errors import UserError
from madviz.recorded.known import LABEL, SUITE, recordings_of
from madviz.recorded.moment import RecordedMoment, RecordedState
from madviz.recorded.robot import robot_of
from madviz.types import (
    Array,
    Body,
    CameraPose,
    CameraSpec,
    EnvSpec,
    TimeStep,
    View,
)

BESIDE = 1.15
"""Distance from camera to camera: they have no place, so their pictures stand in a row."""
AHEAD = (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0)
"""OpenCV's axes, upright, looking along the world's y."""
FOVY = 60.0


class RecordedRobot:
    """A ``madviz.types.Environment``. State and action: those of the dataset, scaled."""

    setting_cameras: Mapping[str, tuple[CameraSpec, ...]] = {}

    @staticmethod
    def describe(task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> EnvSpec:
        """The facts of ``task``; ``render_profile`` makes no difference."""
        name = f"{SUITE}/{task}"
        found = recordings_of(name)
        own = tuple(
            CameraSpec(one.name, one.name.replace("_", " ").capitalize(), FOVY, (BESIDE * i, 0, 0))
            for i, one in enumerate(found.cameras)
        )
        spread = robot_of(found).scaled_spread
        return EnvSpec(
            name,
            resized_cameras(name, own, cameras),
            state_dim=len(found.state_names),
            action_dim=len(found.action_names),
            horizon=max(max(one.length for one in found.episodes) - 1, 1),
            render_profile=render_profile,
            success=f"none: {LABEL}",
            instruction=found.episodes[0].task,
            action_spread=tuple(spread.tolist()),
        )

    def __init__(
        self,
        task: str,
        render_profile: str = "fast",
        cameras: tuple[CameraSpec, ...] = (),
    ) -> None:
        """``task`` and ``render_profile`` are those of ``make_env``. Raises UserError for
        recordings that nobody has named, and for ``cameras`` that are not its own."""
        self.spec = self.describe(task, render_profile, cameras)
        self._found = recordings_of(self.spec.task)
        self._states = self._raw = np.zeros((1, self.spec.state_dim), np.float32)
        self._actions = np.zeros((1, self.spec.action_dim), np.float32)
        self._episode = self._found.episodes[0]
        self._step = 0

    def reset(self, seed: int) -> TimeStep:
        episodes = self._found.episodes
        self._episode = episodes[seed % len(episodes)]
        self._raw, actions = self._found.numbers(self._episode.index)
        robot = robot_of(self._found)
        self._states = robot.states.scale(self._raw)  # (T, S)
        self._actions = robot.actions.scale(actions)  # (T, A)
        self._step = 0
        return self._now()

    def step(self, action: Array) -> TimeStep:
        check_action(action, self.spec.action_dim)
        self._step += 1
        return self._now()

    def view(self, camera: str, size: int | None = None) -> View:
        spec = self.spec.camera(camera)
        size = size or spec.size
        check_size(size)
        frames = self._found.frames(self._episode.index, size)  # (T, V, H, W, 3)
        number = [one.name for one in self._found.cameras].index(camera)
        picture = np.array(frames[self._row, number])
        return View(picture, np.ones((size, size), np.float32))

    def pose(self, camera: str) -> CameraPose:
        position = np.array(self.spec.camera(camera).position, float)
        return CameraPose(position, np.array(AHEAD), FOVY)

    def move_camera(self, camera: str, to: CameraSpec | None) -> None:
        self.spec.camera(camera)
        if to is not None:
            raise UserError(
                f"expected cameras of {self.spec.task} where they stood, found {camera!r} "
                "elsewhere: a recording shows one place only; occlude the camera or drop it"
            )

    def bodies(self) -> tuple[Body, ...]:
        return ()

    def body_poses(self) -> Array:
        return np.zeros((0, 7), np.float32)

    def hand(self) -> Array:
        return np.zeros(3, np.float32)

    def expert(self) -> Array:
        return np.clip(self._actions[self._row], -1, 1)

    def recorded(self) -> RecordedMoment:
        one = self._episode
        return RecordedMoment(self._actions[self._row], one.index, one.task, max(one.length - 1, 1))

    def close(self) -> None:
        pass

    @property
    def _row(self) -> int:
        return min(self._step, len(self._states) - 1)

    def _now(self) -> TimeStep:
        last = self._step >= max(len(self._states) - 1, 1)
        row = self._row
        state = RecordedState.of(self._states[row], self._raw[row], self._episode.task)
        return TimeStep(state, 0.0, success=False, last=last)
