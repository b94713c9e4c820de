"""One episode, and processes that run many.

An episode is a pure function of policy, subset, occlusions and seed, to the bit: whatever ran
before it, in whichever process, beside however many others. Two things would break that. PyTorch
splits sums differently over different numbers of threads, so an episode always computes on one. And
OpenGL and PyTorch do not survive a fork, so workers are spawned and load what they need themselves.

A process dies now and then (out of memory, killed by a user). The standard library then gives up
the whole pool; ``Workers`` starts another one, and whoever submitted submits again what had not
finished. An episode lasts seconds, so that is all that is lost.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.measure.mean_picture import stack_of
from madviz.measure.store import EpisodeResult, ResultKey
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.displacement import Displacement, Moves
from madviz.policies import checkpoint
from madviz.policies.config import check_environment, definition_of
from madviz.policies.players import player_of
from madviz.policies.seeds import FIRST_DEVELOPMENT
from madviz.subsets import camera_of, cameras_of, mask_of, name_of
from madviz.system.processes import set_up_worker
from madviz.types import Array, Environment, Policy, PolicySpec

Occlusions = tuple[tuple[str, Occlusion], ...]
Finished = tuple[EpisodeResult, str]
"""An episode's result and the definition of success it was judged by."""

FIRST_SEED = FIRST_DEVELOPMENT
"""Of evaluations whose seeds nobody named."""
GIVE_UP = 3
"""Pools that may break in a row, without a single episode finished, before it is an error."""

LOADED = 4
"""Policies a process keeps loaded: visitors of a page compare a few, and take turns."""


class Stopped(Exception):
    """The episode was abandoned because its evaluation is being closed."""


@dataclass(frozen=True)
class Job:
    """One episode to run, in words that travel to another process."""

    policy: str
    digest: str
    """Of the policy's files when the job was made; a process with another version reloads."""
    subset: str
    occlusions: Occlusions
    seed: int
    moves: Moves = ()
    """Cameras that do not stand where the policy was trained."""

    def key(self, spec: PolicySpec, definition: str) -> ResultKey:
        """Where the result is stored, given the policy's own spec."""
        return ResultKey(
            digest=spec.digest,
            task=spec.task,
            definition=definition,
            render_profile=spec.render_profile,
            occlusions=occlusion_key(dict(self.occlusions), dict(self.moves)),
            subset=self.subset,
        )


def occlusion_key(
    occlusions: dict[str, Occlusion], moves: dict[str, Displacement] | None = None
) -> str:
    """A name for occlusions and moves by camera; '' where there are none."""
    states = {camera: CameraState(occlusion=o) for camera, o in occlusions.items()}
    return Ablation(states, moves or {}).key()


def claimed_definition(policy: str) -> str:
    """The definition of success in a policy folder's config: part of the key of stored results."""
    return checkpoint.describe(policy).config.definition


def relevant(occlusions: dict[str, Occlusion], mask: Array, streams: tuple[str, ...]) -> Occlusions:
    """What a policy on the subset ``mask`` can notice of occlusions, in a fixed order."""
    present = cameras_of(tuple(s for s, on in zip(streams, mask, strict=True) if on))
    noticed = [camera for camera in sorted(occlusions) if camera in present]
    return tuple((c, occlusions[c].effective) for c in noticed if occlusions[c].kind != "none")


def unsupported(spec: PolicySpec, mask: Array) -> UserError:
    """The error for a subset ``mask`` (V,) bool that a policy cannot act on."""
    return UserError(
        f"{spec.name} cannot act on {name_of(mask, spec.streams)!r}; "
        f"it was trained on: {', '.join(spec.trained_subsets)}"
    )


def run_episode(
    policy: Policy,
    env: Environment,
    mask: Array,
    ablation: Ablation,
    seed: int,
    stop: Callable[[], bool] = lambda: False,
) -> EpisodeResult:
    """Runs the episode ``seed`` on the subset ``mask`` (V,) bool; of ``ablation`` the occlusions.

    Only cameras that are present are drawn; dropped streams cannot reach the sum, so they may as
    well be black. Raises UserError if the policy cannot act on the subset, Stopped if ``stop``
    says so between two decisions.
    """
    streams = policy.spec.streams
    if not policy.supports(mask):
        raise unsupported(policy.spec, mask)
    cameras = dict.fromkeys(camera_of(s) for s, on in zip(streams, mask, strict=True) if on)
    stack = stack_of(policy.spec, env.spec)
    now, total, success_any, decision = env.reset(seed), 0.0, False, 0
    with closing(player_of(policy, seed)) as player:
        while not now.last:
            if stop():
                raise Stopped
            views = {camera: env.view(camera) for camera in cameras}
            stack.push(views, ablation, seed, decision)
            now = env.step(player.act(policy.encode(stack.views, now.state), mask))
            total += float(now.reward)
            success_any |= bool(now.success)
            decision += 1
    return EpisodeResult(name_of(mask, streams), seed, bool(now.success), success_any, total)


class Runner:
    """Runs jobs in this process; keeps the last few policies and the last environment."""

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        self._stop = stop
        self._policies: dict[tuple[str, str], Policy] = {}
        self._env: tuple[tuple[Any, ...], Environment] | None = None
        self._moved: set[str] = set()
        """Cameras of that environment that may not stand where its spec has them."""

    def opened(self, job: Job) -> tuple[Environment, Policy]:
        """What ``job`` needs: the environment stays until a job needs another one."""
        policy = self._loaded(job.policy, job.digest)
        return self._environment(policy), policy

    def run(self, job: Job) -> Finished:
        """Plays the job's episode. Raises UserError if its policy's files changed meanwhile."""
        env, policy = self.opened(job)
        self._place(env, dict(job.moves))
        mask = mask_of(job.subset, policy.spec.streams)
        ablation = Ablation.from_mask(mask, policy.spec.streams, dict(job.occlusions))
        with one_thread():
            result = run_episode(policy, env, mask, ablation, job.seed, self._stop)
        return result, definition_of(env.spec)

    def _place(self, env: Environment, moves: dict[str, Displacement]) -> None:
        """Every camera where the job has it, whatever the job before did."""
        for camera in sorted(self._moved | moves.keys()):
            to, spec = moves.get(camera), env.spec.camera(camera)
            self._moved.add(camera)
            env.move_camera(camera, to.placed(spec) if to else None)
        self._moved = set(moves)

    def adopt(self, reference: str, policy: Policy) -> None:
        """Makes an object that exists already answer to ``reference``."""
        self._policies[reference, policy.spec.digest] = policy

    def close(self) -> None:
        """Closes the environment."""
        if self._env:
            self._env[1].close()
        self._env, self._moved = None, set()

    def _loaded(self, reference: str, digest: str) -> Policy:
        key = (reference, digest)
        if key not in self._policies:
            policy = checkpoint.load_policy(reference)
            if policy.spec.digest != digest:
                raise UserError(f"{reference} was changed while it was evaluated; start again")
            if len(self._policies) == LOADED:
                del self._policies[next(iter(self._policies))]
            self._policies[key] = policy
        return self._policies[key]

    def _environment(self, policy: Policy) -> Environment:
        key = (policy.spec.task, policy.spec.render_profile, policy.spec.cameras)
        if self._env is None or self._env[0] != key:
            self.close()
            self._env = key, make_env(*key)
        check_environment(policy.spec, self._env[1].spec)
        return self._env[1]


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread, if it was imported; see the module."""
    torch: Any = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Workers:
    """``count`` processes that run jobs; started at the first one, replaced when they die."""

    def __init__(self, count: int, niceness: int = 0) -> None:
        if count < 1:
            raise UserError(f"expected one worker process or more, found {count}")
        self.count = count
        self._niceness = niceness
        self._context = multiprocessing.get_context("spawn")
        # Shared memory without a lock: a worker that is killed cannot leave it locked.
        self._stop = self._context.RawValue("b", 0)
        self._pool: ProcessPoolExecutor | None = None
        self.generation = 0
        """Counts the pools; a job knows from which one it came."""

    def submit(self, job: Job) -> Future[Finished]:
        """Starts a job as soon as a process is free. Its result may be BrokenProcessPool."""
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                self.count, self._context, _start, (self._stop, self._niceness)
            )
        try:
            return self._pool.submit(_work, job)
        except BrokenProcessPool:  # It broke since it was last asked.
            self.renew(self.generation)
            return self.submit(job)

    def renew(self, generation: int) -> None:
        """Forgets the broken pool of ``generation``, unless that has happened already.

        It is not shut down: a broken pool ends its processes by itself, and completes its futures
        while it holds the lock that ``shutdown`` would wait for.
        """
        if generation == self.generation:
            self._pool, self.generation = None, generation + 1

    def gave_up(self) -> UserError:
        """What to say after GIVE_UP broken pools."""
        return UserError(
            f"expected worker processes to live, found {GIVE_UP} deaths in a row without a "
            "finished episode; out of memory? try --workers 1, or 0 to see the error in this "
            "process (a script needs `if __name__ == '__main__':` around what it runs)"
        )

    def close(self) -> None:
        """Abandons what runs at its next decision, and what waits."""
        self._stop.value = 1
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = None


# --- In a worker process ----------------------------------------------------------------------


class _Process:
    """What a worker process holds between jobs."""

    stop: Any = None

    @cached_property
    def runner(self) -> Runner:
        return Runner(lambda: bool(self.stop.value))


_process = _Process()


def _start(stop: Any, niceness: int) -> None:
    """Runs once in a new process."""
    set_up_worker(niceness)
    _process.stop = stop


def _work(job: Job) -> Finished:
    return _process.runner.run(job)
