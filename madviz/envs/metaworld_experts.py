"""Meta-World's scripted experts, asked every decision, and made to stay where they succeeded.

The scripts know the object's true position. Several go on after the goal is reached and spoil it
by the last step, so the expert holds still while the task's own condition is true: no motion, and
the script's gripper effort. Because that depends on the present state alone, it can also label the
states of a student, which is what the light recipe asks of it."""

from __future__ import annotations

import warnings

import numpy as np

from madviz.types import Array

METAWORLD_SUCCESS = {
    "basketball": "the ball is within 0.08 m of the hoop's goal",
    "hammer": "the nail is driven in by more than 0.09 m",
    "peg-insert-side": "the peg's head is within 0.07 m of the end of the hole",
    "soccer": "the ball is within 0.07 m of the goal",
    "sweep-into": "the cube is within 0.05 m of the goal in the hole",
    "assembly": "the wrench's ring is aligned with the peg and hooked over it",
    "hand-insert": "the cube is within 0.05 m of the goal in the hole",
    "pick-out-of-hole": "the puck is within 0.07 m of the goal",
    "pick-place": "the puck is within 0.07 m of the goal",
    "push": "the puck is within 0.05 m of the goal",
    "shelf-place": "the cube is within 0.07 m of the goal on the shelf",
    "disassemble": "the wrench is lifted above the peg",
    "stick-pull": "the thermos handle is within 0.12 m of the goal and the stick is through it",
    "stick-push": "the thermos is within 0.12 m of the goal and the stick is held",
    "pick-place-wall": "the puck is within 0.07 m of the goal behind the wall",
}
"""Each task's condition in the pinned version, in words for cards and pages."""


class Expert:
    """The scripted policy of one task."""

    def __init__(self, task: str) -> None:
        from metaworld.policies import ENV_POLICY_MAP

        # The scripts' gains are meant to saturate; actions are clipped below.
        warnings.filterwarnings("ignore", "Constant.s. may be too high", module="metaworld")
        self._script = ENV_POLICY_MAP[f"{task}-v3"]()

    def action(self, observation: Array, success: bool) -> Array:
        """(A,) for Meta-World's full observation (39,), which holds the object's position."""
        action = np.clip(self._script.get_action(observation), -1, 1).astype(np.float32)
        if success:
            action[:3] = 0.0
        return action
