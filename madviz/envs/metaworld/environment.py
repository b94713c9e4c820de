"""Meta-World v3 as the paper uses it: 15 tasks, three cameras, action repeat 2, 200 simulator
steps.

Pictures are upright and *not* mirrored. (The paper's own are mirrored left to right, an artefact of
its frame buffer; a page that shows pictures beside the 3D scene must not be.) ``third_a`` and
``third_b`` are the paper's moved corner cameras, whose model orientation is upside down and is
therefore rolled by half a turn; ``first`` stays at a constant world offset from the hand, and its
orientation in the world does not change.

The state is eight numbers (hand x y z in metres and gripper opening, now and one simulator step
ago) for each of three decisions: 24, as in the paper's code. It holds neither object nor goal. The
paper's table says 4; ``EnvSpec.state_numbers`` names those, for policies that shall read no more.

Resets draw from a generator of the instance's own. Meta-World would use NumPy's global one, and
several simulations side by side would then change each other's scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from madviz.envs.cameras import look_at, standing_camera
from madviz.envs.checks import check_action
from madviz.envs.metaworld.experts import MetaWorldExpert
from madviz.envs.mujoco.gl import check_gl
from madviz.envs.mujoco.world import MuJoCoWorld
from madviz.envs.placement import drawn_cameras
from madviz.envs.tasks import INSTRUCTIONS, METAWORLD_SUCCESS
from madviz.state_numbers import StateNumbers
from madviz.types import Array, CameraSpec, EnvSpec, TimeStep

ACTION_REPEAT = 2
HORIZON = 100
HAND = (16, 17, 18, 19)
"""The state numbers of the hand now, and ``HAND_BEFORE`` a decision ago."""
HAND_BEFORE = (8, 9, 10, 11)

CAMERAS = (
    CameraSpec(
        "first",
        "First person",
        fovy=90,
        position=(0.040, 0.010, 0.059),
        wxyz=(0.99909, 0.04265, 0.0, 0.0),
        body="hand",
        depth_range=(0.0, 0.45),
    ),
    CameraSpec(
        "third_a",
        "Third A",
        fovy=60,
        position=(0.75, 0.075, 0.7),
        wxyz=(0.76536, 0.43494, 0.26267, 0.39504),
        depth_range=(0.5, 1.7),
    ),
    CameraSpec(
        "third_b",
        "Third B",
        fovy=45,
        position=(0.72, 0.1, 1.2),
        wxyz=(0.82385, 0.25594, 0.10574, 0.49455),
        depth_range=(0.8, 2.0),
    ),
)
"""The paper's cameras in world terms, with the roll already applied (fact sheet of the method)."""

_FIRST, _, _THIRD_B = CAMERAS
SETTING_CAMERAS: dict[str, tuple[CameraSpec, ...]] = {
    "five": (
        standing_camera("third_c", "Third C", 60, (-0.75, 0.8, 0.65), (0.0, 0.68, 0.1), (0.5, 1.7)),
        standing_camera("top", "Top", 50, (0.0, 0.8, 1.3), (0.0, 0.68, 0.0), (0.6, 1.4)),
    ),
    "turned-away": (
        replace(_FIRST, wxyz=look_at((0, 0, 0), (1.0, 0.0, 0.45))),
        replace(_THIRD_B, wxyz=look_at((0, 0, 0), (0.87, 0.0, 0.5))),
    ),
}
"""By setting, the cameras added or moved. ``third_c`` looks across the table from the side opposite
Third A, so that what the arm hides from one the other sees; ``top`` looks down on it from its far
end. In ``turned-away`` First looks to the robot's right over the table's edge, and Third B at the
sky (the paper says "uninformative directions" and gives none); neither sees hand, object or goal,
but for the thermos of the stick tasks, which stands on First's way."""


class MetaWorld(MuJoCoWorld):
    """One task, a ``madviz.types.Environment``. Only the thread that makes it may use it.

    ``simulation`` is Meta-World's own environment, and ``observation`` (39,) what it observes:
    hand, objects and goal, now and one simulator step ago.
    """

    setting_cameras = SETTING_CAMERAS

    @staticmethod
    def describe(task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> EnvSpec:
        """The facts of ``task``, without a simulator."""
        return EnvSpec(
            f"metaworld/{task}",
            drawn_cameras(CAMERAS, cameras),
            state_dim=24,
            state_numbers=StateNumbers(
                paper=HAND, robot=HAND, changes=tuple(zip(HAND, HAND_BEFORE, strict=True))
            ),
            action_dim=4,
            gripper="closes at 1",
            horizon=HORIZON,
            action_repeat=ACTION_REPEAT,
            render_profile=render_profile,
            success=METAWORLD_SUCCESS[task],
            instruction=INSTRUCTIONS[f"metaworld/{task}"],
        )

    def __init__(
        self, task: str, render_profile: str = "fast", cameras: tuple[CameraSpec, ...] = ()
    ) -> None:
        """``cameras`` as in ``make_env``. Raises UserError for one on a body that is not there."""
        spec = self.describe(task, render_profile, cameras)
        self.simulation = _simulation(task)
        super().__init__(spec, self.simulation.model, self.simulation.data)
        self._expert = MetaWorldExpert(task)
        self.observation = np.zeros(39)
        self._states: list[Array] = []
        self._step = 0
        self._success = False

    def reset(self, seed: int) -> TimeStep:
        return self.reset_in_pieces(seed, lambda: None)

    def reset_in_pieces(self, seed: int, between: Callable[[], None]) -> TimeStep:
        """Meta-World lets the hand settle for 100 times five physics steps, some 40 ms."""
        with _called_between(self.simulation, between):
            return self._begin(seed)

    def _begin(self, seed: int) -> TimeStep:
        simulation = self.simulation
        simulation.seed(seed)
        simulation.reset()
        # The first real step makes the frame-difference half of the observation valid.
        self.observation, _, _, _, info = simulation.step(np.zeros(4, np.float32))
        self._step = 0
        self._success = bool(info["success"])
        self._states = [self._frame_state()] * 3
        self.moved()
        return TimeStep(self._state(), 0.0, self._success, last=False)

    def step(self, action: Array) -> TimeStep:
        check_action(action, self.spec.action_dim)
        clipped = np.clip(np.asarray(action, np.float32), -1, 1)
        reward = 0.0
        info = {}
        for _ in range(self.spec.action_repeat):
            self.observation, gained, _, _, info = self.simulation.step(clipped)
            reward += float(gained)
        self._step = self._step + 1
        self._success = bool(info["success"])
        self._states = [*self._states[1:], self._frame_state()]
        self.moved()
        return TimeStep(self._state(), reward, self._success, self._ended())

    def _ended(self) -> bool:
        return self._step >= self.spec.horizon

    def hand(self) -> Array:
        return np.asarray(self.simulation.tcp_center, np.float32)

    place_names = ("object", "second object", "goal")

    def places(self) -> Array:
        # Two objects, of which the second may not be there and is then zero, and the goal.
        parts = [self.observation[4:7], self.observation[11:14], self.observation[36:39]]
        return np.concatenate(parts).astype(np.float32)

    def expert(self) -> Array:
        return self._expert.action(self.observation, self._success)

    def _frame_state(self) -> Array:
        return np.concatenate([self.observation[:4], self.observation[18:22]]).astype(np.float32)

    def _state(self) -> Array:
        return np.concatenate(self._states)


@contextmanager
def _called_between(simulation: Any, between: Callable[[], None]) -> Iterator[None]:
    """Has ``between`` called after every few physics steps of ``simulation``."""

    def do_simulation(ctrl: Any, n_frames: int) -> None:
        type(simulation).do_simulation(simulation, ctrl, n_frames)
        between()

    simulation.do_simulation = do_simulation
    try:
        yield
    finally:
        del simulation.do_simulation


def _simulation(task: str) -> Any:
    check_gl()
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

    build: Any = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"]
    simulation = build(seed=0)
    simulation._freeze_rand_vec = False
    simulation.seeded_rand_vec = True
    return simulation
