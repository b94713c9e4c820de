"""Meta-World as LeRobot's own environment has it, for policies that were trained there.

                     metaworld/hammer                   lerobot/hammer
    a decision       two simulator steps                one
    state            24 numbers                         4: hand x y z and gripper opening, now
    first look       after a step that does nothing     right after the reset
    an episode       100 decisions                      until the first success, 500 at most
    words            ours                               LeRobot's

``third_a`` is its one camera: the corner that LeRobot moves to (0.75, 0.075, 0.7), whose picture it
turns by half a turn. In the ``full`` render profile, at 480 pixels, picture and state are LeRobot's
(LeRobot 0.6.1), but for some 2 of 10,000 pixels at edges. The other cameras are ours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from madviz.envs.metaworld.environment import CAMERAS, MetaWorld
from madviz.state_numbers import StateNumbers
from madviz.types import Array, CameraSpec, EnvSpec, TimeStep, View

HORIZON = 500
_THIRD_A = CAMERAS[1]
CORNER = replace(_THIRD_A, wxyz=(0.76536295, 0.43493704, 0.26266734, 0.39503823))
"""The corner with all digits of the model: other digits move edges by a part of a pixel."""
INSTRUCTIONS = {
    "basketball": "Dunk the basketball into the basket",
    "hammer": "Hammer a screw on the wall",
    "peg-insert-side": "Insert a peg sideways",
    "soccer": "Kick a soccer into the goal",
    "sweep-into": "Sweep a puck into a hole",
    "assembly": "Pick up a nut and place it onto a peg",
    "hand-insert": "Insert the gripper into a hole",
    "pick-out-of-hole": "Pick up a puck from a hole",
    "pick-place": "Pick and place a puck to a goal",
    "push": "Push the puck to a goal",
    "shelf-place": "Pick and place a puck onto a shelf",
    "disassemble": "Pick a nut out of a peg",
    "stick-pull": "Grasp a stick and pull a box with the stick",
    "stick-push": "Grasp a stick and push a box using the stick",
    "pick-place-wall": "Pick a puck, bypass a wall and place the puck",
}
"""By task, the sentences of LeRobot 0.6.1 (Apache-2.0), which its policies of language know."""


class LeRobotMetaWorld(MetaWorld):
    """One task, see the module."""

    _unused: Array | None = None
    """MuJoCo's state before the first episode."""

    @staticmethod
    def describe(task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> EnvSpec:
        own = tuple(CORNER if one.name == CORNER.name else one for one in CAMERAS)
        return replace(
            MetaWorld.describe(task, render_profile, cameras or own),
            task=f"lerobot/{task}",
            state_dim=4,
            state_numbers=StateNumbers(),
            horizon=HORIZON,
            action_repeat=1,
            instruction=INSTRUCTIONS[task],
        )

    def _begin(self, seed: int) -> TimeStep:
        import mujoco  # With metaworld, not before.

        # Its reset puts a goal where a body lay before: all must lie as in a new environment.
        model = self._model
        data = self._data
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        if self._unused is None:
            self._unused = np.empty(mujoco.mj_stateSize(model, kind))
            mujoco.mj_getState(model, data, self._unused, kind)
        mujoco.mj_setState(model, data, self._unused, kind)
        mujoco.mj_forward(model, data)
        self.simulation.seed(seed)
        self.observation, _ = self.simulation.reset()
        self._step = 0
        self._success = False
        self._states = [self._frame_state()]
        self.moved()
        return TimeStep(self._state(), 0.0, False, last=False)

    def view(self, camera: str, size: int | None = None) -> View:
        """Drawn upside down and then turned, as LeRobot does: so edges fall on the same pixels."""
        placed = self.placed(camera)
        w, x, y, z = placed.wxyz
        seen = self.view_from(replace(placed, wxyz=(-z, y, -x, w)), size)
        return View(_turned(seen.rgb), _turned(seen.depth))

    def _frame_state(self) -> Array:
        return self.observation[:4].astype(np.float32)

    def _state(self) -> Array:
        return self._states[-1]

    def _ended(self) -> bool:
        return self._success or super()._ended()


def _turned(picture: Array) -> Array:
    """(H, W, ...) by half a turn."""
    return np.ascontiguousarray(np.flip(picture, (0, 1)))
