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

The same processes play a policy's evaluations, an episode each at a time, while nothing is learned.
"""

from __future__ import annotations

import multiprocessing
import pickle
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np

from madviz.errors import UserError
from madviz.measure.episodes import Stopped, one_thread, run_episode
from madviz.measure.store import EpisodeResult
from madviz.observation.ablation import Ablation
from madviz.observation.streams import IMAGE_SIZE, channels_of
from madviz.runs.drawn_task import DrawnTask, newest_frames
from madviz.system.processes import set_up_worker
from madviz.types import Array, Environment, Policy, TimeStep

LISTEN_SECONDS = 0.5
"""How often a stop is looked for while episodes are played; those that have begun are finished."""


class Board:
    """Shared memory with a row for every lane; goes to workers when they are spawned."""

    def __init__(self, lanes: int, streams: Sequence[str], state_dim: int, action_dim: int) -> None:
        numbers = [
            ("action", "f4", (action_dim,)),
            ("state", "f4", (state_dim,)),
            ("reward", "f4"),
            ("last", "?"),
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
        self._policy: Policy | None = None

    def reset(self, seeds: Sequence[int]) -> None:
        """A new episode in every lane; ``seeds`` are all lanes', here and elsewhere."""
        for place, env in zip(self._places, self._envs, strict=True):
            self._show(place, env, env.reset(seeds[place]))

    def step(self) -> None:
        """The actions on the board."""
        actions = self._board["action"]
        for place, env in zip(self._places, self._envs, strict=True):
            self._show(place, env, env.step(actions[place]))

    def repeat(self, seeds: Sequence[int], actions: Array) -> None:
        """Episodes again up to where they were; ``actions`` is (age, L, A). Draws nothing."""
        for place, env in zip(self._places, self._envs, strict=True):
            env.reset(seeds[place])
            for action in actions[:, place]:
                env.step(action)

    def load(self, pickled: bytes) -> None:
        """The policy that ``play`` plays. As bytes, because a pipe would put its weights into
        memory that is shared with whoever learns."""
        self._policy = pickle.loads(pickled)

    def play(
        self, mask: Array, seed: int, stop: Callable[[], bool] = lambda: False
    ) -> EpisodeResult:
        """An episode in the first lane, whose own must be over."""
        assert self._policy is not None
        with one_thread():
            return run_episode(self._policy, self._envs[0], mask, Ablation(), seed, stop)

    def close(self) -> None:
        for env in self._envs:
            env.close()

    def _show(self, place: int, env: Environment, now: TimeStep) -> None:
        board = self._board
        board["state"][place] = now.state
        board["reward"][place] = now.reward
        board["last"][place] = now.last
        frames = newest_frames(env, self._streams)
        for stream, frame in zip(self._streams, frames, strict=True):
            board[stream][place] = frame


class VectorEnvs:
    """``lanes`` environments in ``workers`` processes; see the module."""

    def __init__(self, drawn_task: DrawnTask, board: Board, lanes: int, workers: int) -> None:
        """``lanes`` from 1 on, ``workers`` from 0 on. Raises what building an environment does."""
        self.board = board
        self.lanes = lanes
        self._streams = drawn_task.streams
        self._here = None if workers else Lanes(drawn_task, board, range(lanes))
        shares = [s.tolist() for s in np.array_split(np.arange(lanes), min(workers or 1, lanes))]
        self._workers = [_Worker(drawn_task, board, share) for share in shares] if workers else []
        try:
            self._wait()
        except BaseException:
            self.close()
            raise

    def reset(self, seeds: list[int]) -> None:
        """A new episode in every lane; returns when all have begun."""
        self._order("reset", seeds)
        self._wait()

    def send(self, actions: Array) -> None:
        """Starts a step with ``actions`` (L, A); ``receive`` must follow."""
        self.board["action"][:] = actions
        self._order("step")

    def receive(self) -> None:
        """Waits for the step that was sent; its outcome is on the board then."""
        self._wait()

    def repeat(self, seeds: list[int], actions: Array) -> None:
        """Puts every lane where ``actions`` (age, L, A) lead from its seed."""
        self._order("repeat", seeds, actions)
        self._wait()

    def play(
        self, policy: Policy, jobs: Sequence[tuple[Array, int]], stop: Callable[[], bool]
    ) -> list[EpisodeResult]:
        """An episode of ``policy`` for each of ``jobs``, a mask (V,) and a seed. No lane may be in
        mid-episode. Raises Stopped if ``stop`` says so."""
        self._order("load", pickle.dumps(policy))
        self._wait()
        if self._here is not None:
            return [self._here.play(mask, seed, stop) for mask, seed in jobs]
        left = list(range(len(jobs)))
        results = dict[int, EpisodeResult]()
        playing: dict[Connection, tuple[_Worker, int]] = {}
        try:
            while left or playing:
                if stop():
                    raise Stopped
                for worker in self._workers:
                    if left and worker.connection not in playing:
                        playing[worker.connection] = worker, left.pop(0)
                        worker.send(("play", *jobs[playing[worker.connection][1]]))
                for answered in wait(list(playing), LISTEN_SECONDS):
                    assert isinstance(answered, Connection)
                    worker, job = playing.pop(answered)
                    results[job] = worker.wait()
        finally:
            for worker, _ in playing.values():
                worker.wait()  # No answer may be left in a pipe.
        return [results[job] for job in range(len(jobs))]

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

    def wait(self) -> Any:
        """Until it has done what was asked, for what came of it; raises what went wrong there."""
        try:
            answer = self.connection.recv()
        except (EOFError, OSError) as error:
            raise self._died() from error
        if isinstance(answer, Exception):
            raise answer
        return answer

    def end(self) -> None:
        """Waits for a process whose connection is closed."""
        self._process.join(timeout=5)
        if self._process.is_alive():
            self._process.kill()

    def _died(self) -> UserError:
        self._process.join(timeout=5)
        return UserError(
            "expected the processes that step environments to live, found one dead (exit code "
            f"{self._process.exitcode}); out of memory? try fewer workers and go on "
            "with --resume (a script needs `if __name__ == '__main__':` around what it runs)"
        )


def _work(
    connection: Connection, drawn_task: DrawnTask, board: Board, places: Sequence[int]
) -> None:
    """Runs in a worker process, until the other end of the connection is closed."""
    set_up_worker()
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
