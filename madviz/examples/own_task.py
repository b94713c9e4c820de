"""A task of your own on MuJoCo: a hand has to touch a ball that floats over a table.

    madviz train --task madviz.examples.own_task:make --recipe light --out runs/touch
    madviz explore --task madviz.examples.own_task:make --policy runs/touch

The scene is MuJoCo's XML; ``MuJoCoWorld`` draws it, for policies and for the page, from cameras
that need not be in it. What is left is the task: how an episode begins, what a decision does, when
it is a success, and, for the light recipe, what an expert who knows where the ball is would do.

An episode must depend on its seed alone, last ``horizon`` decisions, and hold in its state nothing
that a camera should have to see: here the hand's own position, and not the ball's. Simulators
other than MuJoCo need all parts of ``madviz.types.Environment``; ``envs/toy.py`` has them by hand.
"""

from __future__ import annotations

import mujoco
import numpy as np

from madviz.envs.cameras import standing_camera
from madviz.envs.checks import check_action
from madviz.envs.mujoco.world import MuJoCoWorld
from madviz.types import Array, CameraSpec, EnvSpec, TimeStep

SCENE = """
<mujoco>
  <worldbody>
    <light pos="0 0 2"/>
    <geom name="table" type="box" size="0.5 0.5 0.02" pos="0 0 -0.02" rgba="0.55 0.45 0.35 1"/>
    <body name="hand" mocap="true">
      <geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.025" rgba="0.2 0.5 0.9 1"/>
    </body>
    <body name="ball" mocap="true"><geom type="sphere" size="0.04" rgba="0.9 0.35 0.1 1"/></body>
  </worldbody>
</mujoco>
"""
HAND = 0
BALL = 1
STEP = 0.04
"""Metres the hand moves for an action of 1."""
NEAR = 0.065
"""Metres between the middles of fingertip and ball when they touch."""
LOW = np.array([-0.4, -0.4, 0.05])
HIGH = np.array([0.4, 0.4, 0.4])
"""Corners of the box, in metres, that hand and ball stay in."""


MIDDLE = (0.0, 0.0, 0.15)
DEPTHS = (0.3, 2.0)
CAMERAS = (
    CameraSpec("first", "First person", 90, (0, 0, 0.12), (1, 0, 0, 0), "hand", (0.0, 0.5)),
    standing_camera("third_a", "Third A", 60, (0.9, -0.5, 0.6), MIDDLE, DEPTHS),
    standing_camera("third_b", "Third B", 60, (-0.7, -0.8, 0.7), MIDDLE, DEPTHS),
)
"""Named as everywhere, so that every setting of three cameras fits; other names are as good."""


class TouchBall(MuJoCoWorld):
    """State: the hand's x, y, z. Action: x, y, z."""

    def __init__(self) -> None:
        success = "the hand touches the ball"
        spec = EnvSpec("touch-ball", CAMERAS, 3, 3, horizon=40, success=success)
        model = mujoco.MjModel.from_xml_string(SCENE)
        super().__init__(spec, model, mujoco.MjData(model))
        self._step = 0

    def reset(self, seed: int) -> TimeStep:
        rng = np.random.default_rng(seed)
        self._data.mocap_pos[HAND] = rng.uniform(LOW, HIGH)
        self._data.mocap_pos[BALL] = rng.uniform(LOW, HIGH)
        self._step = 0
        return self._now()

    def step(self, action: Array) -> TimeStep:
        check_action(action, self.spec.action_dim)
        moved = self._data.mocap_pos[HAND] + STEP * np.clip(action, -1, 1)
        self._data.mocap_pos[HAND] = np.clip(moved, LOW, HIGH)
        self._step += 1
        return self._now()

    def hand(self) -> Array:
        return self._data.mocap_pos[HAND].astype(np.float32)

    def expert(self) -> Array:
        return np.clip(self._left() / STEP, -1, 1).astype(np.float32)

    def _now(self) -> TimeStep:
        mujoco.mj_forward(self._model, self._data)
        self.moved()
        distance = float(np.linalg.norm(self._left()))
        last = self._step >= self.spec.horizon
        return TimeStep(self.hand(), 1 - np.tanh(5 * distance), distance < NEAR, last)

    def _left(self) -> Array:
        return self._data.mocap_pos[BALL] - self._data.mocap_pos[HAND]


def make() -> TouchBall:
    """The factory that ``--task madviz.examples.own_task:make`` calls."""
    return TouchBall()
