"""Scripted experts of the ManiSkill tasks, in the policy's own actions.

An action moves the tool point by at most 0.1 m a decision in x, y, z and says how far the gripper
is open (1) or closed (-1). Each expert looks at the true positions of now and nothing else: which
phase it is in follows from where things are. So it can also label the states of a student, which is
what the light recipe asks of it, and it recovers from being pushed off its path.

The controller moves the tool point about half of what an action asks for, and its inverse
kinematics fails for large steps near the arm's reach (x = 0.17 m with the hand pointing down): far
targets are approached in small steps. The gripper cannot be turned; its fingers open along x.

Poking needs a tool: the cube has to go where the arm cannot reach. The peg lies along x and is too
long to be grasped that way, so the hand pushes its near end (its tail) along x.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from madviz.envs.maniskill.tasks import position
from madviz.types import Array

OPEN = 1.0
CLOSED = -1.0
FAR_OUT = 0.06
FAR_OUT_LIMIT = 0.3
"""Metres of x from which on the action outwards stays at the limit: near the arm's reach."""
STEP = 0.1
"""Metres of tool point motion that an action of 1 asks for."""
GAIN = 1.3
"""Metres asked for over metres wanted: the controller moves less than an action asks for."""
ABOVE = 0.08
"""Metres over an object at which the gripper travels to it."""
AT_FLANK = 0.035
"""Metres in y from the peg's middle to the tool point when the open fingers touch its flank."""
HALF_PEG = 0.12
HALF_CUBE = 0.02
"""Metres from the peg's middle to its ends, and from the cube's to its faces."""
TOUCHING = 0.06
"""Metres in x from the tool point to the peg's tail when the open front finger touches it."""
ROOM = 0.025
"""Metres between front finger and tail from which the hand moves sideways behind the peg."""
IN_HAND = 0.006
"""Metres of the tool point above a grasped sphere's middle."""
CALM = 0.4
"""Radians a second of the arm's quickest joint at which a hand is nearly at rest."""
SINKING = 0.15
"""Limit of an action's z while a sphere is lowered into the bin: it sinks at 0.11 to 0.12 m/s, and
without the limit at 0.3."""
GRIPPER_IS_OPEN = 0.035
"""Metres of one finger; 0.04 is all the way."""


def expert_action(task: str, simulation: Any) -> Array:
    """(4,) float32 in [-1, 1]: tool point x, y, z and gripper, by the script of ``task``, of which
    ``simulation`` is the running one. Raises KeyError for a task without a script."""
    action = np.clip(_SCRIPTS[task](simulation), -1, 1).astype(np.float32)
    if position(simulation.agent.tcp)[0] > FAR_OUT:
        action[:3] *= min(1.0, FAR_OUT_LIMIT / max(action[0], 1e-9))
    return action


def _towards(error: Array, gripper: float, limit: float = 1.0, gain: float = GAIN) -> Array:
    """The action that closes ``error`` (3,), metres; its longest component is at most ``limit``,
    and its direction stays."""
    motion = gain * error / STEP
    return np.append(motion * min(1.0, limit / max(np.abs(motion).max(), 1e-9)), gripper)


def _slide(simulation: Any, sign: float) -> Array:
    """Moves the cube along ``sign`` x with the closed fingers behind it."""
    tool = position(simulation.agent.tcp)
    cube = position(simulation.obj)
    left = sign * (position(simulation.goal_region) - cube)[0]
    ahead = sign * (tool - cube)[0]
    aside = abs(tool - cube)[1]
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
    tool = position(simulation.agent.tcp)
    cube = position(simulation.cube)
    if simulation.agent.is_grasping(simulation.cube)[0]:
        return _towards(position(simulation.goal_site) - cube, CLOSED, 0.7)
    return _grasp(tool, cube)


def _place(simulation: Any) -> Array:
    """Carries by where the hand is and lets go as soon as the bin's walls will do the rest: a pixel
    of a camera that stands aside is a centimetre, so no student could follow a script that waits
    for a few millimetres, and the bin needs none.

    What it does need is a hand that is nearly at rest and a slow way down. A sphere that meets a
    wall while it is held, or leaves a moving hand, begins to spin. In the bin it touches the
    ground at one point, where nothing stops a spin about the vertical axis, and a sphere that spins
    does not count as resting. No camera shows it, so no student could cure it. Lowered at full
    speed, 2 of 200 episodes without noise ended so; lowered slowly, none. With normal noise of 0.1
    on every action 185 of 200 episodes succeed.
    """
    tool = position(simulation.agent.tcp)
    sphere = position(simulation.obj)
    rest = position(simulation.bin) + [0, 0, 0.0225]  # Half a bottom plus the sphere's radius.
    if simulation.agent.is_grasping(simulation.obj)[0]:
        error = rest + [0, 0, IN_HAND] - tool
        aside = np.hypot(error[0], error[1])
        if aside < 0.012 and error[2] > -0.02:
            speed = np.abs(simulation.agent.robot.get_qvel()[0, :7].numpy()).max()
            return np.array([0, 0, 0, OPEN]) if speed < CALM else _towards(0.5 * error, CLOSED)
        if aside > 0.025:
            return _towards(error + [0, 0, 0.045], CLOSED, 0.45)
        action = _towards(error, CLOSED, 0.45)
        action[2] = np.clip(action[2], -SINKING, SINKING)
        return action
    error = rest - sphere
    if np.hypot(error[0], error[1]) < 0.02 and abs(error[2]) < 0.025:
        opened = float(simulation.agent.robot.get_qpos()[0, -1]) > GRIPPER_IS_OPEN
        return _towards(np.array([0, 0, 0.15 - tool[2] if opened else 0.0]), OPEN, 0.5)
    return _grasp(tool, sphere + [0, 0, IN_HAND])


def _poke(simulation: Any) -> Array:
    """Lines the peg up with the cube where it must, and pushes its tail until the cube is there.

    What a student can follow decides the shape: it is off by a centimetre in all it sees, so
    nothing here hangs on one. A cube that sits up to 25 mm aside is still pushed; otherwise the
    hand goes beside the peg, from where it makes 15 mm of them, and which of the two is under way
    shows in where the hand is. The push ends 3 cm before the goal, of 5 cm that success allows, and
    the hand draws back by 2 cm. From there it pushes again only if 6 cm are left: its errors do not
    move the peg, and all actions are zero.

    The peg slides on: 15 mm from 0.3 m/s, four times as far from twice that. A peg that was pushed
    past the cube costs 16 of the 50 decisions, as the hand has to go to its other side. So the last
    centimetres sideways are slow, and the hand leaves the peg before it goes back along it, or it
    takes the peg along.

    Without noise 60 of 60 episodes succeed; with normal noise of 0.15 on every action but the last
    five, 200 of 220. With peg, cube and goal seen 8 mm off in x and in y, by an error that changes
    slowly, 117 of 150; a script that lined up to 8 mm at one speed and had no such rest at the end
    did so in 102.
    """
    tool = position(simulation.agent.tcp)
    peg = position(simulation.peg)
    cube = position(simulation.cube)
    goal = position(simulation.goal_region)
    yaw = _yaw(simulation.peg)
    tail = peg - [HALF_PEG * np.cos(yaw), HALF_PEG * np.sin(yaw), 0]
    left = (goal - cube)[0]
    aside = (cube - peg)[1]
    low = tool[2] < 0.05
    room = tail[0] - TOUCHING - tool[0]
    drawn_back = low and 0.008 < room < 0.04
    if left < (0.06 if drawn_back else 0.03):
        return _towards(np.array([0.0 if drawn_back else min(room - 0.02, 0), 0, 0]), OPEN, 0.4)
    if low and room > -0.015:
        return _push_tail(cube, peg, left, yaw, np.array([room, (tail - tool)[1], 0.03 - tool[2]]))
    away = abs(peg - tool)
    beside = low and away[1] > 0.03
    if cube[0] - peg[0] > 0.17 and abs(aside) > (0.015 if beside and away[0] < 0.03 else 0.025):
        return _line_up(tool, peg, aside)
    behind = np.array([room - ROOM, (tail - tool)[1], 0.03 - tool[2]])
    if beside:  # Along the peg, at a distance from it.
        clear = peg[1] + 0.06 * np.sign((tool - peg)[1])
        fastest = [1.0 if away[1] > 0.045 else 0.3, 0.5, 1.0]
        error = np.array([behind[0], clear - tool[1], behind[2]])
        return np.append(np.clip(GAIN * error / STEP, np.negative(fastest), fastest), OPEN)
    if low:
        return np.array([0, 0, 1, OPEN])
    if np.hypot(*behind[:2]) > 0.025:
        return _towards(behind + [0, 0, 0.06], OPEN)
    return _towards(behind, OPEN, 0.8)


def _push_tail(cube: Array, peg: Array, left: float, yaw: float, error: Array) -> Array:
    """From behind the peg: into line with its tail, and forwards.

    ``error`` (3,) metres: from the front finger to the tail in x and y, and to the height at which
    it pushes. The peg, turned by ``yaw``, is steered to where its head meets the cube's middle, by
    pushing beside the middle of its tail. The last ``left`` metres of the cube go slower and
    slower, because it slides on: 27 mm from 0.4 m/s.
    """
    room, across, up = error
    if abs(across) > 0.015:
        if room < ROOM - 0.012:  # A finger that moves sideways here would take the tail along.
            return _towards(np.array([min(room - ROOM, -0.02), 0, up]), OPEN, 0.8)
        return _towards(np.array([room - ROOM, across, up]), OPEN, 0.8)
    gap = max((cube - peg)[0] - HALF_PEG - HALF_CUBE, 0)
    speed = np.clip(gap + 0.5 * (left - 0.01), 0.02, 0.06)
    turn = yaw - np.clip((cube - peg)[1] / HALF_PEG - np.sin(yaw), -0.12, 0.12)
    return _towards(np.array([speed, across + np.clip(0.3 * turn, -0.02, 0.02), up]), OPEN, 0.5)


def _yaw(thing: Any) -> float:
    """Radians by which an actor that stands upright is turned about z."""
    w, _, _, z = np.asarray(thing.pose.q[0], float)
    return float(2 * np.arctan2(z, w))


def _line_up(tool: Array, peg: Array, aside: float) -> Array:
    """Pushes the peg sideways by ``aside`` metres, slower towards the end. The open fingers touch
    its flank at two places, so that it turns little."""
    behind = np.sign(aside) * (peg - tool)[1]
    error = peg - [0, np.sign(aside) * 0.06, 0] - tool
    if tool[2] < 0.045 and behind > 0.02:
        reach = np.sign(aside) * max(behind - AT_FLANK, 0) + aside
        limit = min(0.6, 0.3 + 4 * abs(aside))
        return _towards(np.array([error[0], reach, error[2]]), OPEN, limit, 1.0)
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
