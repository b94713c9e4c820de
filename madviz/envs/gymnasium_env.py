"""madviz's tasks for programs that speak Gymnasium.

    import gymnasium, madviz
    env = gymnasium.make("madviz/hammer-v0")

An observation is a table, named as LeRobot names it:

    pixels     {first, third_a, third_b}   (H, W, 3) uint8
    depth      the same cameras            (H, W, 1) float32, metres, in the 256 steps of the
                                           camera's range in which a policy gets it here
    agent_pos  (S,) float32

``flat=True`` puts all of it side by side (``first``, ``first_depth``, ``agent_pos``), for programs
that take no tables in tables, as Stable-Baselines3. An episode never ends early; ``is_success`` is
the task's condition at this very step. The seed of ``reset`` is the episode's, as everywhere here.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, Error, ResetNeeded

from madviz.envs.registry import SUITES, env_spec, make_env
from madviz.system.depth import depth_code, depth_metres
from madviz.types import Array, CameraSpec, Environment, TimeStep

NAMESPACE = "madviz"
SEEDS = 2**31
Observation = dict[str, Any]
_IMPORTED_IN = os.getpid()
_drawn_in: set[int] = set()
"""Processes in which a simulator of OpenGL has drawn."""


class MadvizEnv(gymnasium.Env[Observation, Array]):
    """One task. Only the thread that makes it may use it, because OpenGL contexts belong to one."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        task: str,
        *,
        size: int = 84,
        depth: bool = True,
        flat: bool = False,
        render_profile: str = "fast",
        render_mode: str | None = None,
    ) -> None:
        """``task`` as in ``make_env``; ``size`` in pixels. Raises UserError, and Gymnasium's Error
        for a size that is none."""
        if size < 1:
            raise Error(f"expected a size of at least 1 pixel, found {size}")
        facts = env_spec(task, render_profile)
        cameras = tuple(replace(camera, size=size) for camera in facts.cameras)
        self._cameras: tuple[CameraSpec, ...] = cameras
        self._forked = _graphics_forked(task)
        # A simulator that is made in such a process may wait for ever; ``reset`` says so instead.
        self._made = None if self._forked else make_env(task, render_profile, cameras)
        self._closed = False
        self._begun = False
        self._depth = depth
        self._flat = flat
        self.render_mode = render_mode
        self.task = task
        self.task_description = facts.instruction
        self._max_episode_steps = facts.horizon
        self.action_space = spaces.Box(-1, 1, (facts.action_dim,), np.float32)
        self.observation_space = self._space(facts.state_dim)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins the episode of ``seed``; of none, of one that is drawn."""
        if self._forked:
            raise Error(
                f"{self.task}: a process forked from one that has drawn cannot draw; add "
                'vector_kwargs={"context": "spawn"} to gymnasium.make_vec, or start it so'
            )
        super().reset(seed=seed)
        world = self._world
        self._begun = True
        if not self.task.startswith("toy/"):
            _drawn_in.add(os.getpid())
        number = int(self.np_random.integers(SEEDS)) if seed is None else seed % SEEDS
        return self._observed(world.reset(number))

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One decision; the episode is cut off at its horizon. Raises Gymnasium's errors before
        ``reset`` and after ``close``."""
        self._check_begun("step")
        moment = self._world.step(np.asarray(action, np.float32))
        observation, info = self._observed(moment)
        return observation, float(moment.reward), False, moment.last, info

    def render(self) -> Array | None:  # type: ignore[override]
        """All cameras beside each other, (H, 3 W, 3) uint8; None where nobody asked for it."""
        if self.render_mode is None:
            return None
        self._check_begun("render")
        return np.concatenate(
            [self._world.view(camera.name).rgb for camera in self._cameras], axis=1
        )

    def close(self) -> None:
        """Frees what the simulator and the renderer hold."""
        if self._made is not None and not self._closed:
            self._made.close()
        self._closed = True

    @property
    def _world(self) -> Environment:
        if self._closed or self._made is None:
            raise ClosedEnvironmentError(f"{self.task}: expected an environment that is not closed")
        return self._made

    def _check_begun(self, name: str) -> None:
        if not self._closed and not self._begun:
            raise ResetNeeded(f"{self.task}: expected reset() before {name}()")

    def _observed(self, moment: TimeStep) -> tuple[Observation, dict[str, Any]]:
        views = {camera.name: self._world.view(camera.name) for camera in self._cameras}
        pixels = {name: np.asarray(view.rgb, np.uint8) for name, view in views.items()}
        observation: Observation = {"pixels": pixels}
        if self._depth:
            observation["depth"] = {
                camera.name: depth_metres(
                    depth_code(views[camera.name].depth, camera.depth_range), camera.depth_range
                )
                for camera in self._cameras
            }
        observation["agent_pos"] = np.asarray(moment.state, np.float32)
        info = {"is_success": bool(moment.success), "task": self.task}
        return flattened(observation) if self._flat else observation, info

    def _space(self, state_dim: int) -> spaces.Dict:
        pixels = {}
        depth = {}
        for camera in self._cameras:
            shape = (camera.size, camera.size)
            pixels[camera.name] = spaces.Box(0, 255, (*shape, 3), np.uint8)
            depth[camera.name] = spaces.Box(*camera.depth_range, (*shape, 1), np.float32)
        parts: Observation = {"pixels": pixels}
        if self._depth:
            parts["depth"] = depth
        parts["agent_pos"] = spaces.Box(-np.inf, np.inf, (state_dim,), np.float32)
        if self._flat:
            return spaces.Dict(flattened(parts))
        inner: dict[str, spaces.Space[Any]] = {
            name: spaces.Dict(part) if isinstance(part, dict) else part
            for name, part in parts.items()
        }
        return spaces.Dict(inner)


def flattened(parts: Observation) -> Observation:
    """``{pixels: {first}, depth: {first}}`` -> ``{first, first_depth}``."""
    flat: Observation = dict(parts["pixels"])
    flat.update({f"{name}_depth": picture for name, picture in parts.get("depth", {}).items()})
    return {**flat, "agent_pos": parts["agent_pos"]}


def _graphics_forked(task: str) -> bool:
    """True where this process was forked from one whose simulator of ``task`` had drawn: neither
    OpenGL nor SAPIEN works on in such a process."""
    if os.getpid() == _IMPORTED_IN or task.startswith("toy/"):
        return False
    if task.startswith("maniskill/"):
        return "sapien" in sys.modules and os.getpid() not in _drawn_in
    return bool(_drawn_in) and os.getpid() not in _drawn_in


def ids() -> dict[str, str]:
    """Gymnasium's name of every task: ``madviz/hammer-v0`` for ``metaworld/hammer``."""
    return {
        f"{NAMESPACE}/{task}-v0": f"{suite}/{task}"
        for suite, s in SUITES.items()
        if s.listed
        for task in s.tasks
    }


def register() -> None:
    """Makes all of ``ids`` known to Gymnasium; importing this file does it."""
    for name, task in ids().items():
        if name not in gymnasium.registry:
            place = f"{MadvizEnv.__module__}:{MadvizEnv.__name__}"
            gymnasium.register(name, entry_point=place, kwargs={"task": task})


register()
