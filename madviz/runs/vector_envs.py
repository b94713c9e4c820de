"""Many environments at once: worker processes that step them, and memory they share.

    learner     writes actions, says "step", learns meanwhile, waits, reads
                     |                                           ^
    board       actions (L, A)     frames (L, H, W, C) per stream, states, rewards
                     v                                           |
    workers     each steps its own lanes and draws their cameras into the board

Pictures never travel through a pipe: 8 environments with three cameras send half a megabyte at
every step. All lanes step together and their episodes are equally long, so what happens depends on
seeds and actions alone, and not on how many processes share the work: with 0 workers this process
does it all, and the numbers are the same.

A policy's evaluations are played in the same lanes, an episode in each, while nothing is learned:
the learner's process encodes all of them at once, and only cameras that an episode sees are drawn.
"""

from __future__ import annotations

import itertools
import multiprocessing
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from madviz.agent.agent import TorchPolicy
from madviz.errors import UserError
from madviz.measure.episodes import Stopped, one_thread
from madviz.measure.store import EpisodeResult
from madviz.observation.streams import IMAGE_SIZE, channels_of, to_channels
from madviz.runs.drawn_task import DrawnTask, newest_frames
from madviz.subsets import camera_of, name_of
from madviz.system.processes import set_up_worker_of_training
from madviz.types import Array, Environment, TimeStep


class Board:
    """Shared memory with a row for every lane; goes to workers when they are spawned."""

    def __init__(self, lanes: int, streams: Sequence[str], state_dim: int, action_dim: int) -> None:
        numbers = [
            ("action", "f4", (action_dim,)),
            ("state", "f4", (state_dim,)),
            ("reward", "f8"),
            ("last", "?"),
            ("success", "?"),
        ]
        size = (IMAGE_SIZE, IMAGE_SIZE)
        frames = [(stream, "u1", (*size, channels_of(stream))) for stream in streams]
        self._row = np.dtype([*numbers, *frames], align=True)
        context = multiprocessing.get_context("spawn")
        self._memory: Any = context.RawArray("B", lanes * self._row.itemsize)

    def __getitem__(self, name: str) -> Array:
        """(L, ...) called ``name``; what is written to it, the other processes see."""
        return np.frombuffer(self._memory, self._row)[name]


class Lanes:
    """Some of the environments, in the process that steps them."""

    def __init__(self, drawn_task: DrawnTask, board: Board, places: Sequence[int]) -> None:
        self._streams = drawn_task.streams
        self._board = board
        self._places = places
        self._envs = [drawn_task.build() for _ in places]
        self._shown: list[tuple[str, ...]] = []

    def reset(self, seeds: Sequence[int], masks: Array) -> None:
        """A new episode in each of the first lanes, as many as there are ``seeds``: all lanes',
        here and elsewhere. Cameras without a stream in ``masks`` (L, V) are not drawn."""
        self._shown = [self._drawn(mask) for mask in masks]
        for place, env in self._running():
            self._show(place, env, env.reset(seeds[place]))

    def step(self) -> None:
        """The actions on the board."""
        actions = self._board["action"]
        for place, env in self._running():
            self._show(place, env, env.step(actions[place]))

    def repeat(self, seeds: Sequence[int], actions: Array) -> None:
        """Episodes again up to where they were; ``actions`` is (age, L, A). Draws nothing."""
        self._shown = [self._streams] * len(seeds)
        for place, env in self._running():
            env.reset(seeds[place])
            for action in actions[:, place]:
                env.step(action)

    def close(self) -> None:
        for env in self._envs:
            env.close()

    def _running(self) -> list[tuple[int, Environment]]:
        """The lanes with an episode."""
        lanes = zip(self._places, self._envs, strict=True)
        return [(place, env) for place, env in lanes if place < len(self._shown)]

    def _drawn(self, mask: Array) -> tuple[str, ...]:
        """All streams of the cameras that have one in ``mask`` (V,)."""
        cameras = {camera_of(stream) for stream in itertools.compress(self._streams, mask)}
        return tuple(stream for stream in self._streams if camera_of(stream) in cameras)

    def _show(self, place: int, env: Environment, now: TimeStep) -> None:
        board = self._board
        board["state"][place] = now.state
        board["reward"][place] = now.reward
        board["last"][place] = now.last
        board["success"][place] = now.success
        shown = self._shown[place]
        for stream in self._streams:
            if stream not in shown:
                board[stream][place] = 0
        for stream, frame in zip(shown, newest_frames(env, shown), strict=True):
            board[stream][place] = frame


class VectorEnvs:
    """``lanes`` environments in ``workers`` processes; see the module."""

    def __init__(self, drawn_task: DrawnTask, board: Board, lanes: int, workers: int) -> None:
        """``lanes`` from 1 on, ``workers`` from 0 on. Raises what building an environment does."""
        self.board = board
        self.lanes = lanes
        self._streams = drawn_task.streams
        self._here = None if workers else Lanes(drawn_task, board, range(lanes))
        # In turn, so that each has its share also where fewer lanes are played.
        shares = [range(lanes)[first::workers] for first in range(min(workers, lanes))]
        self._workers = [_Worker(drawn_task, board, share) for share in shares]
        try:
            self._wait()
        except BaseException:
            self.close()
            raise

    def reset(self, seeds: list[int]) -> None:
        """A new episode in every lane; returns when all have begun."""
        self._order("reset", seeds, np.ones((len(seeds), len(self._streams)), bool))
        self._wait()

    def send(self, actions: Array) -> None:
        """Starts a step with ``actions`` (L, A) of the lanes that run; ``receive`` must follow."""
        self.board["action"][: len(actions)] = actions
        self._order("step")

    def receive(self) -> None:
        """Waits for the step that was sent; its outcome is on the board then."""
        self._wait()

    def repeat(self, seeds: list[int], actions: Array) -> None:
        """Puts every lane where ``actions`` (age, L, A) lead from its seed."""
        self._order("repeat", seeds, actions)
        self._wait()

    def play(
        self, policy: TorchPolicy, jobs: Sequence[tuple[Array, int]], stop: Callable[[], bool]
    ) -> list[EpisodeResult]:
        """An episode of ``policy`` for each of ``jobs``, a mask (V,) that it supports and a seed:
        those of ``run_episode``, but for rounding. No lane may be in mid-episode. Raises Stopped if
        ``stop`` says so between two decisions."""
        together = [jobs[i : i + self.lanes] for i in range(0, len(jobs), self.lanes)]
        with one_thread():
            return [result for some in together for result in self._play(policy, some, stop)]

    def _play(
        self, policy: TorchPolicy, jobs: Sequence[tuple[Array, int]], stop: Callable[[], bool]
    ) -> list[EpisodeResult]:
        """At most as many as there are lanes."""
        count = len(jobs)
        board = self.board
        masks = np.stack([mask for mask, _ in jobs])  # (L, V)
        self._order("reset", [seed for _, seed in jobs], masks)
        self._wait()
        # An episode's first frame stands for those before it.
        views = np.tile(self._newest(count), (1, 1, policy.spec.frame_stack, 1, 1))
        success = board["success"][:count].copy()
        success_any = np.zeros(count, bool)
        total = np.zeros(count)
        running = ~board["last"][:count]
        while running.any():  # A lane whose episode is over is stepped on, and counts no more.
            if stop():
                raise Stopped
            self.send(policy.act_together(views, board["state"][:count], masks))
            self.receive()
            views = np.concatenate([views[:, :, 3:], self._newest(count)], 2)
            success[running] = board["success"][:count][running]
            success_any |= board["success"][:count] & running
            total += np.where(running, board["reward"][:count], 0.0)
            running &= ~board["last"][:count]
        return [
            EpisodeResult(
                name_of(mask, self._streams),
                seed,
                success=bool(success[lane]),
                success_any=bool(success_any[lane]),
                total_reward=float(total[lane]),
            )
            for lane, (mask, seed) in enumerate(jobs)
        ]

    def _newest(self, count: int) -> Array:
        """(L, V, 3, H, W): the newest frames of the first ``count`` lanes."""
        lanes = [np.stack(list(map(to_channels, self.frames(lane)))) for lane in range(count)]
        return np.stack(lanes)

    def frames(self, lane: int) -> list[Array]:
        """The newest frame (H, W, C) of every stream; it changes with the next step."""
        return [self.board[stream][lane] for stream in self._streams]

    def close(self) -> None:
        if self._here is not None:
            self._here.close()
        for worker in self._workers:
            worker.connection.close()  # All at once: a simulator may need seconds to end.
        for worker in self._workers:
            worker.end()
        self._workers = []

    def _order(self, name: str, *arguments: Any) -> None:
        if self._here is not None:
            getattr(self._here, name)(*arguments)
        for worker in self._workers:
            worker.send((name, *arguments))

    def _wait(self) -> None:
        for worker in self._workers:
            worker.wait()


class _Worker:
    """A process with some lanes, seen from here."""

    def __init__(self, drawn_task: DrawnTask, board: Board, places: Sequence[int]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_work, args=(theirs, drawn_task, board, places), daemon=True
        )
        self._process.start()
        theirs.close()  # So that its death is heard.

    def send(self, order: tuple[Any, ...]) -> None:
        try:
            self.connection.send(order)
        except OSError as error:
            raise self._died() from error

    def wait(self) -> None:
        """Until it has done what was asked; raises what went wrong there."""
        try:
            answer = self.connection.recv()
        except (EOFError, OSError) as error:
            raise self._died() from error
        if isinstance(answer, Exception):
            raise answer

    def end(self) -> None:
        """Waits for a process whose connection is closed."""
        self._process.join(timeout=5)
        if self._process.is_alive():
            self._process.kill()

    def _died(self) -> UserError:
        self._process.join(timeout=5)
        return UserError(
            "expected the processes that step environments to live, found one dead (exit code "
            f"{self._process.exitcode}); out of memory? try fewer workers, with --resume and "
            "the same --threads (a script needs `if __name__ == '__main__':` around what it runs)"
        )


def _work(
    connection: Connection, drawn_task: DrawnTask, board: Board, places: Sequence[int]
) -> None:
    """Runs in a worker process, until the other end of the connection is closed."""
    set_up_worker_of_training()
    lanes: Lanes | None = None
    try:
        lanes = Lanes(drawn_task, board, places)
        connection.send(None)
        while True:
            name, *arguments = connection.recv()
            connection.send(getattr(lanes, name)(*arguments))
    except (EOFError, OSError):
        pass
    except UserError as error:
        connection.send(error)
    except Exception:
        connection.send(RuntimeError(f"in a worker process:\n{traceback.format_exc()}"))
    finally:
        if lanes is not None:
            lanes.close()
