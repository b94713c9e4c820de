"""``toy/reach``: a numpy-only world that draws in microseconds, for tests and first lessons.

A hand has to reach a target on a table. The three cameras see the same table differently, as the
real ones do: ``first`` rides on the hand and sees only its neighbourhood, ``third_a`` looks along
one diagonal and ``third_b`` from straight above. Each alone is enough to find the target, given
time; the state (hand position over three frames) never contains it. Depth is real as well: the
hand floats 0.2 m above the table, the target is a 0.1 m high block.
"""

from __future__ import annotations

import numpy as np

from madviz.envs.base import check_action
from madviz.types import Array, CameraPose, CameraSpec, EnvSpec, TimeStep, View, unknown

STEP = 0.12
"""Metres the hand moves for an action of 1."""
RADIUS = 0.12
"""Metres from the target within which the episode counts as a success."""

_DOWN = (1.0, 0.0, 0.0, 0.0)  # An OpenGL camera with identity orientation looks along -z: down.
CAMERAS = (
    CameraSpec("first", "First person", 60, (0, 0, 1.0), _DOWN, body="hand", depth_range=(0, 2)),
    CameraSpec("third_a", "Third A", 60, (0, 0, 2.2), (0.92388, 0, 0, 0.382683)),
    CameraSpec("third_b", "Third B", 60, (0, 0, 2.0), _DOWN),
)
_HALF_WIDTH = {"first": 0.9, "third_a": 1.5, "third_b": 1.15}
_TABLE, _HAND, _TARGET = (120, 100, 80), (60, 120, 230), (230, 90, 40)


class ToyReach:
    """See the module. State: hand x, y and the last two, 6 numbers; action: x, y."""

    def __init__(self) -> None:
        self.spec = EnvSpec(
            "toy/reach",
            CAMERAS,
            state_dim=6,
            action_dim=2,
            horizon=25,
            success=f"the hand is within {RADIUS} m of the target",
        )
        self._hand = self._target = np.zeros(2)
        self._history: list[Array] = []
        self._step = 0

    def reset(self, seed: int) -> TimeStep:
        rng = np.random.default_rng(seed)
        self._hand = rng.uniform(-0.9, 0.9, 2)
        self._target = rng.uniform(-0.9, 0.9, 2)
        self._history = [self._hand] * 3
        self._step = 0
        return TimeStep(self._state(), 0.0, self._near(), last=False)

    def step(self, action: Array) -> TimeStep:
        check_action(action, self.spec.action_dim)
        moved = self._hand + STEP * np.clip(np.asarray(action, float), -1, 1)
        self._hand = np.clip(moved, -1, 1)
        self._history = [*self._history[1:], self._hand]
        self._step += 1
        distance = float(np.linalg.norm(self._hand - self._target))
        last = self._step >= self.spec.horizon
        return TimeStep(self._state(), 1.0 - np.tanh(2 * distance), self._near(), last)

    def view(self, camera: str, size: int | None = None) -> View:
        spec = self.spec.camera(camera)
        size = size or spec.size
        rgb = np.empty((size, size, 3), np.uint8)
        rgb[:] = _TABLE
        top = spec.position[2]
        depth = np.full((size, size), top, np.float32)
        x, y = self._pixels_in_world(camera, size)
        checker = (np.floor(x * 4) + np.floor(y * 4)).astype(int) % 2 == 0
        rgb[checker] -= np.uint8(12)
        rgb[(np.abs(x) > 1.05) | (np.abs(y) > 1.05)] = 40
        for centre, radius, colour, height in (
            (self._target, 0.16, _TARGET, 0.1),
            (self._hand, 0.1, _HAND, 0.2),
        ):
            inside = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
            rgb[inside], depth[inside] = colour, top - height
        return View(rgb, depth)

    def pose(self, camera: str) -> CameraPose:
        spec = self.spec.camera(camera)
        offset = np.array([*self._hand, 0.0]) if spec.body else np.zeros(3)
        w, x, y, z = spec.wxyz
        # OpenGL axes to OpenCV axes is half a turn about x: right-multiplied by (0, 1, 0, 0).
        return CameraPose(np.array(spec.position) + offset, np.array([-x, w, z, -y]), spec.fovy)

    def expert(self) -> Array:
        return np.clip((self._target - self._hand) / STEP, -1, 1).astype(np.float32)

    def close(self) -> None:
        pass

    def _near(self) -> bool:
        return bool(np.linalg.norm(self._hand - self._target) < RADIUS)

    def _state(self) -> Array:
        return np.concatenate(self._history).astype(np.float32)

    def _pixels_in_world(self, camera: str, size: int) -> tuple[Array, Array]:
        """World x and y (H, W), metres, under every pixel's centre."""
        if camera not in _HALF_WIDTH:
            raise unknown("camera", camera, list(_HALF_WIDTH))
        axis = ((np.arange(size) + 0.5) / size * 2 - 1) * _HALF_WIDTH[camera]
        right, up = np.meshgrid(axis, -axis)
        if camera == "first":
            return right + self._hand[0], up + self._hand[1]
        if camera == "third_a":
            return (right - up) / np.sqrt(2), (right + up) / np.sqrt(2)
        return right, up
