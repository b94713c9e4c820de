"""Two distances that stand for a recording where a simulator has success.

Both are in units of the actions' spread: the root mean square, over the numbers of an action that
ever change, of the difference by the standard deviation of that number in the recordings. 1 is as
far as a recorded action typically is from their mean.
"""

from __future__ import annotations

import numpy as np

from madviz.policies.no_policy import NO_POLICY
from madviz.recorded.scaling import apart
from madviz.session.frame import Frame
from madviz.subsets import camera_of


def from_recorded(frame: Frame) -> float:
    """The distance between the action of the policy and the recorded one; NaN without a policy."""
    recorded = frame.world.recorded
    if recorded is None or frame.world.policy.method == NO_POLICY:
        return float("nan")
    return float(apart(frame.action, recorded.action, frame.world.env.action_spread))


def without_camera(frame: Frame, camera: str) -> float:
    """The distance between the policy's actions with and without ``camera``, the others as they
    are now; NaN where one of the two cannot be had."""
    streams = frame.world.policy.streams
    its = np.array([camera_of(stream) == camera for stream in streams])
    probe = frame.world.probe
    rows = [probe.row(frame.mask & ~its), probe.row(frame.mask | its)]
    first, second = (probe.readout.action[row] for row in rows)
    return float(apart(first, second, frame.world.env.action_spread))
