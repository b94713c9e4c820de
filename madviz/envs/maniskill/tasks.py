"""ManiSkill3's five tasks of the paper: how one is built, and what is read from it.

The simulations are ManiSkill's own classes with the wrist-camera Panda, one at a time, physics on
the CPU. They are built directly and not through gymnasium's registry: the paper's own ids
(``PushCube-v2`` and so on) are used by others for different tasks, and nothing here may clash.

An episode shall depend on its seed alone, but PhysX keeps contacts from before a reset: of ten
PlaceSphere episodes in one simulation, three ended elsewhere than in a fresh one. Every reset
therefore builds the physics anew, which takes 0.1 to 0.2 s. That would take seconds if no renderer
were alive (materials would set up Vulkan each time), so ``renderer`` is called first and stays.

The state is joint positions (9), joint speeds (9) and what the task adds, 28 or 29 numbers:

    push-cube, pull-cube      tool point's pose 7, middle of the target 3
    pick-cube, place-sphere   whether the object is grasped 1, tool point's pose 7, goal or bin 3
    poke-cube                 tool point's pose 7, *the peg's present position* 3

The last one is called goal in the paper's code and in ManiSkill, but it is privileged: it shows a
policy where the peg is, whatever its cameras show. It stays, to be comparable. PushCube's target
is where the cube started plus 0.2 m, and PullCube's minus 0.2 m, so they show that as well, except
to policies trained with ``--state no-start``.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from madviz.types import Array

STATE_DIM = {"pick-cube": 29, "place-sphere": 29}
"""The length of the state of tasks that also say whether the object is grasped; others have 28."""


class Bare:
    """Goes before a stock task: no cameras, and no garbage collection on every reset."""

    def _setup_sensors(self, options: dict) -> None:
        self.scene: Any
        self._sensors = self._human_render_cameras = {}
        self.scene.sensors = self.scene.human_render_cameras = {}

    def _clear(self) -> None:
        self.agent = self.scene = None
        self._sensors = {}
        self._human_render_cameras = {}
        self._hidden_objects = []


def build(task: str, extension: type = Bare, **options: Any) -> Any:
    """ManiSkill's simulation of ``task``, whose methods give way to those of ``extension``.
    ``options`` are ManiSkill's own; without any, physics alone and on a CPU."""
    kind: Any = type("Simulation", (extension, _stock_task(task)), {"SUPPORTED_ROBOTS": None})
    # Importing it has set the level: it would warn at every construction that this robot is not on
    # the task's list.
    logging.getLogger("mani_skill ").setLevel(logging.ERROR)
    physics = {"obs_mode": "none", "sim_backend": "physx_cpu", "render_backend": "none"}
    return kind(
        robot_uids="panda_wristcam",
        control_mode="pd_ee_delta_pos",
        reward_mode="normalized_dense",
        **physics | options,
    )


def _stock_task(task: str) -> Any:
    """ManiSkill's own class of ``task``."""
    from mani_skill.envs.tasks import tabletop

    return {
        "push-cube": tabletop.PushCubeEnv,
        "pull-cube": tabletop.PullCubeEnv,
        "pick-cube": tabletop.PickCubeEnv,
        "place-sphere": tabletop.PlaceSphereEnv,
        "poke-cube": tabletop.PokeCubeEnv,
    }[task]


def states(task: str, simulation: Any, info: dict[str, Any]) -> Array:
    """(L, S) float32 of all L copies in ``simulation``, see the module; ``info`` is what the task's
    ``evaluate`` said."""
    robot = simulation.agent.robot
    numbers = [robot.get_qpos(), robot.get_qvel()]
    if task in STATE_DIM:
        grasped = info["is_grasped" if task == "pick-cube" else "is_obj_grasped"]
        numbers.append(grasped.float()[:, None])
    numbers.append(simulation.agent.tcp.pose.raw_pose)
    shown = {"pick-cube": "goal_site", "place-sphere": "bin", "poke-cube": "peg"}
    numbers.append(getattr(simulation, shown.get(task, "goal_region")).pose.p)
    return np.concatenate([column.cpu().numpy().astype(np.float32) for column in numbers], axis=1)


PLACES = {
    "push-cube": ("obj", "goal_region"),
    "pull-cube": ("obj", "goal_region"),
    "pick-cube": ("cube", "goal_site"),
    "place-sphere": ("obj", "bin"),
    "poke-cube": ("peg", "cube", "goal_region"),
}
"""The simulation's objects and its goal, by task."""


def places(task: str, simulation: Any) -> Array:
    """(3 P,) float32 metres, world frame: where they are now."""
    positions = [position(getattr(simulation, name)) for name in PLACES[task]]
    return np.concatenate(positions).astype(np.float32)


def position(thing: Any) -> Array:
    """(3,) float64, metres, world frame, of an actor or a link."""
    return np.asarray(thing.pose.p[0], float)
