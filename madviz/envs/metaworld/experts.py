"""The scripted experts: ours where Meta-World's own do not hold success to the last step.

The scripts know the object's true position. Meta-World's serve three tasks well, except that they
go on after the goal is reached and may spoil it by the last step; they are therefore held still
while the task's own condition is true. For the other twelve, ``scripts.py`` has ours. Either
way the action depends on the present state alone, so it can also label the states of a student,
which is what the light recipe asks of it."""

from __future__ import annotations

import warnings

import numpy as np

from madviz.envs.metaworld.scripts import SCRIPTS, Scene
from madviz.types import Array


class MetaWorldExpert:
    """The scripted policy of one task: ours where there is one, otherwise Meta-World's."""

    def __init__(self, task: str) -> None:
        from metaworld.policies import ENV_POLICY_MAP

        # The scripts' gains are meant to saturate; actions are clipped below.
        warnings.filterwarnings("ignore", "Constant.s. may be too high", module="metaworld")
        self._ours = SCRIPTS.get(task)
        self._theirs = ENV_POLICY_MAP[f"{task}-v3"]()

    def action(self, observation: Array, success: bool) -> Array:
        """(A,) for Meta-World's full observation (39,), which holds the object's position."""
        if self._ours is not None:  # Ours end in a place to be, and so hold by themselves.
            return np.clip(self._ours(Scene(observation)), -1, 1).astype(np.float32)
        action = np.clip(self._theirs.get_action(observation), -1, 1).astype(np.float32)
        if success:
            action[:3] = 0.0
        return action
