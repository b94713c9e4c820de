"""A scene seen from outside, for films: the episode again, in an environment that draws it well.

A policy must see what it was trained on, so its own environment draws without shadows. Here a
second one repeats its actions in the ``full`` render profile, and one of its cameras stands where
hand and objects are in sight.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from madviz.drawing.viewpoint import FOV, first_view, place_and_target, things
from madviz.envs.cameras import look_at
from madviz.envs.checks import largest_view
from madviz.envs.custom import is_own
from madviz.envs.registry import make_env
from madviz.session.frame import Frame
from madviz.types import Array, Environment, TimeStep


class KeepsActions:
    """An environment that remembers what was done in its present episode."""

    def __init__(self, env: Environment) -> None:
        self._env = env
        self.actions: list[Array] = []

    def reset(self, seed: int) -> TimeStep:
        """Begins an episode; earlier actions are forgotten."""
        self.actions = []
        return self._env.reset(seed)

    def step(self, action: Array) -> TimeStep:
        """Keeps the action and takes the step."""
        self.actions.append(np.array(action))
        return self._env.step(action)

    def __getattr__(self, name: str) -> object:
        return getattr(self._env, name)


class SceneView:
    """The scene of one environment, in pictures of ``width`` and ``height`` pixels."""

    def __init__(self, frame: Frame, width: int, height: int) -> None:
        """``frame``: the first one of an episode, which says where to look from. Raises UserError
        where the environment cannot be built."""
        world = frame.world
        profile = world.env.render_profile if is_own(world.env.task) else "full"
        self._env = make_env(world.env.task, profile, world.policy.cameras)
        self._width = width
        self._height = height
        self._drawn = min(width, largest_view(profile))
        self._camera = self._env.spec.cameras[0]
        self._steps = 0
        half = np.tan(FOV / 2) * width / height
        points = np.concatenate(things(frame))
        ahead = first_view(frame)[1]
        place, target = place_and_target(points, ahead, width / height)
        x, y, z = place.tolist()
        self._stands = replace(
            self._camera,
            position=(x, y, z),
            wxyz=look_at((x, y, z), tuple(target.tolist())),
            body=None,
            fovy=float(np.degrees(2 * np.arctan(half))),  # Of a square as wide as the picture.
        )

    def begin(self, seed: int) -> None:
        """The episode of ``seed``."""
        self._steps = 0
        self._env.reset(seed)
        self._env.move_camera(self._camera.name, self._stands)

    def picture(self, actions: list[Array]) -> Array:
        """(height, width, 3) uint8: the scene after ``actions``, of which earlier ones are done."""
        for action in actions[self._steps :]:
            self._env.step(action)
        self._steps = len(actions)
        square = self._env.view(self._camera.name, self._drawn).rgb
        if self._drawn != self._width:
            square = cv2.resize(square, (self._width, self._width))  # (width, width, 3)
        above = (self._width - self._height) // 2
        return square[above : above + self._height]

    def close(self) -> None:
        """Frees the environment."""
        self._env.close()
