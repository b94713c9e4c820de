"""Scripted experts of the ManiSkill tasks, in the policy's own actions.

An action moves the tool point by at most 0.1 m a decision in x, y, z and says how far the gripper
is open (1) or closed (-1). Each expert looks at the true positions of now and nothing else: which
phase it is in follows from where things are. So it can also label the states of a student, which is
what the light recipe asks of it, and it recovers from being pushed off its path.

The controller moves the tool point about half of what an action asks for, and its inverse
kinematics fails for large steps near the arm's reach (x = 0.17 m with the hand pointing down): far
targets are approached in small steps. The gripper cannot be turned; its fingers open along x.

Poking needs a tool: the cube has to go where the arm cannot reach. The peg lies along x and is too
long to be grasped that way, so the fingers press on it from above and drag it: rubber on peg holds
1.15 times the pressure, peg on table only 0.3 times.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from madviz.envs.maniskill.tasks import position
from madviz.types import Array

OPEN, CLOSED = 1.0, -1.0
FAR_OUT, FAR_OUT_LIMIT = 0.06, 0.3
"""Metres of x from which on the action outwards stays at the limit: near the arm's reach."""
STEP = 0.1
"""Metres of tool point motion that an action of 1 asks for."""
ABOVE = 0.08
"""Metres over an object at which the gripper travels to it."""
ON_PEG = 0.0365
"""Metres from the peg's middle up to the tool point when the finger tips touch the peg."""
PRESS = -0.1
"""The downward action that holds the peg by friction and does not tilt the hand."""
REST_HEIGHT = 0.085
"""Metres over the table at which the hand that has poked waits."""
BEHIND = 0.075
"""Metres behind the peg's middle where the fingers press."""
FURTHEST = 0.18
"""Metres of x that the tool point reaches while it presses."""
AT_FLANK = 0.035
"""Metres in y from the peg's middle to the tool point when the open fingers touch its flank."""
POKE_REACH = 0.14
"""Metres from the peg's middle to the cube's when they touch."""
IN_HAND = 0.006
"""Metres of the tool point above a grasped sphere's middle."""
CALM = 0.4
"""Radians a second of the arm's quickest joint at which a hand is nearly at rest."""
GRIPPER_IS_OPEN = 0.035
"""Metres of one finger; 0.04 is all the way."""


class ManiSkillExpert:
    """The script of one task; ``simulation`` is the running one."""

    def __init__(self, task: str) -> None:
        self._script = _SCRIPTS[task]

    def action(self, simulation: Any) -> Array:
        """(4,) float32 in [-1, 1]: tool point x, y, z and gripper."""
        action = np.clip(self._script(simulation), -1, 1).astype(np.float32)
        if position(simulation.agent.tcp)[0] > FAR_OUT:
            action[:3] *= min(1.0, FAR_OUT_LIMIT / max(action[0], 1e-9))
        return action


def _towards(error: Array, gripper: float, limit: float = 1.0, gain: float = 1.3) -> Array:
    """The action that closes ``error`` (3,), metres; its longest component is at most ``limit``,
    and its direction stays."""
    motion = gain * error / STEP
    return np.append(motion * min(1.0, limit / max(np.abs(motion).max(), 1e-9)), gripper)


def _slide(simulation: Any, sign: float) -> Array:
    """Moves the cube along ``sign`` x with the closed fingers behind it."""
    tool, cube = position(simulation.agent.tcp), position(simulation.obj)
    left = sign * (position(simulation.goal_region) - cube)[0]
    ahead, aside = sign * (tool - cube)[0], abs(tool - cube)[1]
    if left < 0.04:
        return np.array([0, 0, 0, CLOSED])
    if aside < 0.015 and ahead < -0.02 and tool[2] < 0.035:
        speed = np.clip(left, 0.03, 0.05)
        return _towards(np.array([sign * speed, cube[1] - tool[1], 0.02 - tool[2]]), CLOSED, 0.5)
    behind = cube - [sign * 0.075, 0, 0]
    if aside < 0.015 and ahead < -0.05:
        return _towards(behind - tool, CLOSED)
    if tool[2] < 0.07 and ahead > -0.055:
        return np.array([0, 0, 1, CLOSED])
    return _towards(behind + [0, 0, ABOVE] - tool, CLOSED)


def _grasp(tool: Array, thing: Array) -> Array:
    """Over ``thing``, down to it, and close."""
    error = thing - tool
    aside = np.hypot(error[0], error[1])
    if aside < 0.012 and abs(error[2]) < 0.012:
        return np.array([0, 0, 0, CLOSED])
    if aside > 0.02:
        error = error + [0, 0, ABOVE]
    return _towards(error, OPEN)


def _pick(simulation: Any) -> Array:
    tool, cube = position(simulation.agent.tcp), position(simulation.cube)
    if simulation.agent.is_grasping(simulation.cube)[0]:
        return _towards(position(simulation.goal_site) - cube, CLOSED, 0.7)
    return _grasp(tool, cube)


def _place(simulation: Any) -> Array:
    """Carries by where the hand is and lets go as soon as the bin's walls will do the rest: a pixel
    of a camera that stands aside is a centimetre, so no student could follow a script that waits
    for a few millimetres, and the bin needs none. It does need a hand that is nearly at rest: from
    a moving one the sphere begins to spin between the walls, where nothing stops it again, and one
    that spins does not count as resting. With normal noise of 0.15 on every action it still
    succeeds in 30 of 32 episodes; waiting for 3 mm, in 3 of 40."""
    tool, sphere = position(simulation.agent.tcp), position(simulation.obj)
    rest = position(simulation.bin) + [0, 0, 0.0225]  # Half a bottom plus the sphere's radius.
    if simulation.agent.is_grasping(simulation.obj)[0]:
        error = rest + [0, 0, IN_HAND] - tool
        aside = np.hypot(error[0], error[1])
        if aside < 0.012 and error[2] > -0.014:
            speed = np.abs(simulation.agent.robot.get_qvel()[0, :7].numpy()).max()
            return np.array([0, 0, 0, OPEN]) if speed < CALM else _towards(0.5 * error, CLOSED)
        over = 0.045 if aside > 0.025 else 0.0
        return _towards(error + [0, 0, over], CLOSED, 0.45)
    error = rest - sphere
    if np.hypot(error[0], error[1]) < 0.02 and abs(error[2]) < 0.025:
        opened = float(simulation.agent.robot.get_qpos()[0, -1]) > GRIPPER_IS_OPEN
        return _towards(np.array([0, 0, 0.15 - tool[2] if opened else 0.0]), OPEN, 0.5)
    return _grasp(tool, sphere + [0, 0, IN_HAND])


def _poke(simulation: Any) -> Array:
    """Lines the peg up with the cube where it must, drags it, and takes the hand off.

    What a student can follow decides the shape. It is off by a centimetre in all it sees, so
    nothing here hangs on one: a cube that sits up to 27 mm aside is still pushed 0.1 m by all of 91
    pegs, so only 22 mm send the hand beside the peg, from where it makes 8 mm of them; and which of
    the two is under way shows in where the hand is. Fingers that slip along the peg press again
    from where they are, as far as the arm's reach has room for it. And a hand that should stop
    while it presses creeps on and takes the cube along; one that lifts has stopped."""
    tool, peg = position(simulation.agent.tcp), position(simulation.peg)
    cube, goal = position(simulation.cube), position(simulation.goal_region)
    left = (goal - cube)[0]
    if left < 0 or np.hypot(*(goal - cube)[:2]) < 0.035:
        return _towards(np.array([0, 0, REST_HEIGHT - tool[2]]), OPEN, 0.4)
    aside = cube[1] - peg[1]
    low = tool[2] < 0.045
    beside = low or abs(peg - tool)[1] > 0.03
    if cube[0] - peg[0] > 0.17 and abs(aside) > (0.008 if beside else 0.022):
        return _line_up(tool, peg, aside)
    if low:
        return np.array([0, 0, 1, OPEN])
    error = peg + [-BEHIND, 0, ON_PEG] - tool
    needed = goal[0] - 0.03 - POKE_REACH - FURTHEST  # Behind the peg's middle, to get there.
    if not np.clip(needed - BEHIND, -0.1, -0.02) < error[0] < 0.025 or abs(error[1]) > 0.02:
        if error[2] > -0.01:  # The fingers are on the peg and would take it along.
            return np.array([0, 0, 0.6, OPEN])
        return _towards(error + [0, 0, 0.4 * ABOVE], OPEN)
    if error[2] < -0.006:
        return _towards(error, OPEN, 0.4)
    gap = max(cube[0] - peg[0] - POKE_REACH, 0)
    speed = np.clip(gap + left - 0.03, 0.035, 0.05)
    limit = 0.4 if tool[0] < FAR_OUT else FAR_OUT_LIMIT if tool[0] < 0.12 else 0.2
    drag = _towards(np.array([speed, 0, 0]), OPEN, limit)
    drag[2] = PRESS
    return drag


def _line_up(tool: Array, peg: Array, aside: float) -> Array:
    """Pushes the peg sideways by ``aside`` metres. The open fingers touch its flank at two places,
    so that it does not turn."""
    behind = np.sign(aside) * (peg - tool)[1]
    error = peg - [0, np.sign(aside) * 0.06, 0] - tool
    if tool[2] < 0.045 and behind > 0.02:
        reach = np.sign(aside) * max(behind - AT_FLANK, 0) + aside
        return _towards(np.array([error[0], reach, error[2]]), OPEN, 0.4, 0.8)
    if behind > 0.045 and abs(error[0]) < 0.03:
        return _towards(error, OPEN)
    if tool[2] < 0.07:
        return np.array([0, 0, 1, OPEN])
    return _towards(error + [0, 0, ABOVE], OPEN)


_SCRIPTS = {
    "push-cube": partial(_slide, sign=1.0),
    "pull-cube": partial(_slide, sign=-1.0),
    "pick-cube": _pick,
    "place-sphere": _place,
    "poke-cube": _poke,
}
