"""Many environments at once, of which ManiSkill makes one simulation on a GPU (``ManiSkillBatch``).

The calls are those of ``VectorEnvs``, and so is the board that is read, here in this process's own
hands: pictures come from the GPU once a step and wait there until the buffer has taken them. What
is sent is stepped when it is asked for, after the updates: the GPU has one thing to do at a time.
"""

from __future__ import annotations

import numpy as np

from madviz.envs.maniskill.batch import ManiSkillBatch, Steps
from madviz.errors import UserError
from madviz.observation.streams import stream_frame
from madviz.subsets import camera_of
from madviz.training.drawn_task import DrawnTask
from madviz.training.vector_envs import Board
from madviz.types import Array, EnvSpec

SUITE = "maniskill/"


def check_batched(task: str) -> None:
    """Raises UserError for a task that no GPU simulates."""
    if not task.startswith(SUITE):
        raise UserError(
            f"expected a task of ManiSkill to simulate on a GPU, found {task}; others step in "
            "processes, leave --vectorised.simulation out"
        )


class BatchedEnvs:
    """``lanes`` environments in one simulation; see the module."""

    def __init__(self, drawn_task: DrawnTask, spec: EnvSpec, board: Board, lanes: int) -> None:
        """``spec`` is that of a single one. Raises UserError as ``ManiSkillBatch`` does."""
        check_batched(drawn_task.task)
        self.board, self.lanes = board, lanes
        self._spec, self._streams = spec, drawn_task.streams
        task = drawn_task.task.removeprefix(SUITE)
        self._batch = ManiSkillBatch(task, lanes, drawn_task.render_profile, drawn_task.cameras)

    def reset(self, seeds: list[int]) -> None:
        """A new episode in every lane."""
        self._show(self._batch.reset(seeds))

    def send(self, actions: Array) -> None:
        """Keeps ``actions`` (L, A); ``receive`` must follow."""
        self.board["action"][:] = actions

    def receive(self) -> None:
        """Steps; the outcome is on the board then."""
        self._show(self._batch.step(self.board["action"]))

    def repeat(self, seeds: list[int], actions: Array) -> None:
        """Puts every lane where ``actions`` (age, L, A) lead; on a GPU nearly so."""
        self._batch.reset(seeds)
        for each in actions:
            self._batch.step(each)

    def frames(self, lane: int) -> list[Array]:
        """The newest frame (H, W, C) of every stream; it changes with the next step."""
        return [self.board[stream][lane] for stream in self._streams]

    def close(self) -> None:
        self._batch.close()

    def _show(self, now: Steps) -> None:
        board, views = self.board, self._batch.draw()
        board["state"][:] = now.state
        board["reward"][:] = now.reward[:, np.newaxis]
        board["last"][:] = now.last
        for stream in self._streams:
            for lane, view in enumerate(views[camera_of(stream)]):
                board[stream][lane] = stream_frame(view, stream, self._spec)
