"""``toy/reach``: a numpy-only world that draws in microseconds, for tests and first lessons.

A hand has to reach a target on a table. The three cameras see the same table differently, as the
real ones do: ``first`` rides on the hand and sees only its neighbourhood, ``third_a`` looks along
one diagonal and ``third_b`` from straight above. Each alone is enough to find the target, given
time; the state (hand position over three frames) never contains it. Depth is real as well: the
hand floats 0.2 m above the table, the target is a 0.1 m high block.

These three are painted as maps, straight from above. A camera that somebody moves is drawn in
perspective instead, by following the ray of every pixel to the flat tops of table, block and hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.envs.checks import check_action, resized_cameras
from madviz.envs.placement import PlacedCameras
from madviz.envs.tasks import INSTRUCTIONS
from madviz.state_numbers import StateNumbers
from madviz.types import Array, Body, CameraSpec, EnvSpec, Part, TimeStep, View

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
_TABLE = (120, 100, 80)
_HAND = (60, 120, 230)
_TARGET = (230, 90, 40)
_TARGET_SIZE = (0.16, 0.1)
_HAND_SIZE = (0.1, 0.2)
"""Radius and height of the top, metres."""
_NOTHING = 40
_FAR = 10.0
"""Grey value and metres of what is not there."""


class ToyReach(PlacedCameras):
    """A ``madviz.types.Environment``. State: hand x, y now and the two before; action: x, y."""

    setting_cameras: Mapping[str, tuple[CameraSpec, ...]] = {}

    @staticmethod
    def describe(task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> EnvSpec:
        """The facts of ``task``; ``render_profile`` makes no difference."""
        return EnvSpec(
            f"toy/{task}",
            resized_cameras(f"toy/{task}", CAMERAS, cameras),
            state_dim=6,
            action_dim=2,
            horizon=25,
            state_numbers=StateNumbers(changes=((4, 2), (5, 3)), robot=(4, 5)),
            success=f"the hand is within {RADIUS} m of the target",
            instruction=INSTRUCTIONS[f"toy/{task}"],
        )

    def __init__(
        self,
        task: str = "reach",
        render_profile: str = "fast",
        cameras: tuple[CameraSpec, ...] = (),
    ) -> None:
        """``task`` and ``render_profile`` are those of ``make_env``; there is one picture for both
        profiles. Raises UserError for ``cameras`` that are not its own in other sizes."""
        super().__init__(self.describe(task, render_profile, cameras), ("hand",))
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
        spec = self.placed(camera)
        size = size or spec.size
        if spec is not self.spec.camera(camera):
            return self._seen_from(spec, size)
        rgb = np.empty((size, size, 3), np.uint8)
        rgb[:] = _TABLE
        top = spec.position[2]
        depth = np.full((size, size), top, np.float32)
        x, y = self._pixels_in_world(camera, size)
        _paint_table(rgb, x, y)
        for centre, (radius, height), colour in self._discs():
            inside = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
            rgb[inside] = colour
            depth[inside] = top - height
        return View(rgb, depth)

    def in_world(self, camera: CameraSpec) -> tuple[Array, Rotation]:
        offset = np.array([*self._hand, 0.0]) if camera.body else np.zeros(3)
        return np.array(camera.position) + offset, Rotation.from_quat(
            camera.wxyz, scalar_first=True
        )

    def bodies(self) -> tuple[Body, ...]:
        return _bodies()

    def body_poses(self) -> Array:
        poses = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (len(_bodies()), 1))
        poses[0, :2] = self._target
        poses[1, :2] = self._hand
        return poses

    def hand(self) -> Array:
        return np.array([*self._hand, _HAND_SIZE[1]], np.float32)

    place_names = ("target",)

    def places(self) -> Array:
        return np.array([*self._target, _TARGET_SIZE[1]], np.float32)

    def expert(self) -> Array:
        return np.clip((self._target - self._hand) / STEP, -1, 1).astype(np.float32)

    def close(self) -> None:
        pass

    def _near(self) -> bool:
        return bool(np.linalg.norm(self._hand - self._target) < RADIUS)

    def _state(self) -> Array:
        return np.concatenate(self._history).astype(np.float32)

    def _discs(self) -> list[tuple[Array, tuple[float, float], tuple[int, int, int]]]:
        """Middle, size and colour of what stands on or above the table, the lower one first."""
        return [(self._target, _TARGET_SIZE, _TARGET), (self._hand, _HAND_SIZE, _HAND)]

    def _seen_from(self, spec: CameraSpec, size: int) -> View:
        """The view of a camera anywhere, by rays; depth is along the optical axis."""
        axis = ((np.arange(size) + 0.5) / size * 2 - 1) * np.tan(np.radians(spec.fovy) / 2)
        right, up = np.meshgrid(axis, -axis)
        rays = np.stack([right, up, -np.ones_like(right)], -1).reshape(-1, 3)
        eye, turn = self.in_world(spec)
        rays = turn.apply(rays).reshape(size, size, 3)
        rgb = np.full((size, size, 3), _NOTHING, np.uint8)
        depth = np.full((size, size), _FAR)
        for centre, (radius, height), colour in [(None, (0, 0.0), _TABLE), *self._discs()]:
            with np.errstate(divide="ignore", invalid="ignore"):
                away = (height - eye[2]) / rays[..., 2]
                x = eye[0] + away * rays[..., 0]
                y = eye[1] + away * rays[..., 1]
                hit = (away > 0) & (away < depth)
            if centre is not None:
                hit &= (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
            rgb[hit] = colour
            depth[hit] = away[hit]
            if centre is None:
                table = rgb[hit][None]
                _paint_table(table, x[hit][None], y[hit][None])
                rgb[hit] = table[0]
        return View(rgb, depth.astype(np.float32))

    def _pixels_in_world(self, camera: str, size: int) -> tuple[Array, Array]:
        """World x and y (H, W), metres, under every pixel's centre."""
        axis = ((np.arange(size) + 0.5) / size * 2 - 1) * _HALF_WIDTH[camera]
        right, up = np.meshgrid(axis, -axis)
        if camera == "first":
            return right + self._hand[0], up + self._hand[1]
        if camera == "third_a":
            return (right - up) / np.sqrt(2), (right + up) / np.sqrt(2)
        return right, up


def _paint_table(rgb: Array, x: Array, y: Array) -> None:
    """Chequers and edge of the table into ``rgb`` (H, W, 3), whose pixels are at ``x``, ``y``."""
    rgb[(np.floor(x * 4) + np.floor(y * 4)).astype(int) % 2 == 0] -= np.uint8(12)
    rgb[(np.abs(x) > 1.05) | (np.abs(y) > 1.05)] = _NOTHING


@cache
def _bodies() -> tuple[Body, ...]:
    """Target, hand and the table in quarters, two of them a little darker: seen from the side they
    give it depth."""
    from madviz.envs import shapes  # Its library takes 0.3 s to load, and few ask for bodies.

    def disc(size: tuple[float, float], low: float, colour: tuple[int, int, int]) -> Part:
        (radius, high), half = size, (size[1] - low) / 2
        middle = (0.0, 0.0, (low + high) / 2)
        return shapes.part(shapes.cylinder(radius, half), np.array(colour) / 255, middle)

    def quarter(x: int, y: int) -> Body:
        colour = (np.array(_TABLE) - (12 if x == y else 0)) / 255
        block = shapes.box(np.array([0.525, 0.525, 0.03]))
        return Body(
            f"table{x:+d}{y:+d}", (shapes.part(block, colour, (0.525 * x, 0.525 * y, -0.03)),)
        )

    return (
        Body("target", (disc(_TARGET_SIZE, 0.0, _TARGET),)),
        Body("hand", (disc(_HAND_SIZE, _HAND_SIZE[1] - 0.04, _HAND),)),
        *(quarter(x, y) for x in (-1, 1) for y in (-1, 1)),
    )
