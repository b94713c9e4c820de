"""One episode: a condition, played on a seed by a policy.

An episode is a pure function of these three, to the bit: whatever ran before it, in whichever
process, beside however many others. PyTorch splits sums differently over different numbers of
threads, so an episode always computes on one.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from madviz.envs.checks import check_ends, check_state
from madviz.envs.registry import env_spec, make_env
from madviz.errors import UserError
from madviz.measure.mean_picture import stack_of
from madviz.measure.store import EpisodeResult
from madviz.observation.ablation import Ablation
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement
from madviz.observation.streams import StreamStack
from madviz.policies import checkpoint
from madviz.policies.config import check_environment, definition_of
from madviz.policies.players import player_of
from madviz.policies.seeds import FIRST_TRY
from madviz.recorded.known import refuse_recording
from madviz.subsets import camera_of, name_of
from madviz.types import Array, Encoded, Environment, Policy, PolicySpec
from madviz.wire.policy import numbers_outside

Finished = tuple[EpisodeResult, str]
"""An episode's result and the definition of success it was judged by."""

Watch = Callable[[Environment, StreamStack, Encoded, Array], None]
"""Called with the environment, the policy's input, its features and the action (A,) of every
decision, before it is carried out. It may draw, and must change nothing."""

FIRST_SEED = FIRST_TRY
"""The first seed of evaluations whose seeds nobody named."""

LOADED = 4
"""Policies a process keeps loaded: visitors of a page compare a few, and take turns."""


class Stopped(Exception):
    """The episode was abandoned because its evaluation is being closed."""


@dataclass(frozen=True)
class Job:
    """One episode to run, in words that travel to another process."""

    policy: str
    digest: str
    """The digest of the policy's files when the job was made. A process with another version
    reloads."""
    condition: Condition
    seed: int
    kept: str = field(default="", compare=False)
    """A folder for what the episode looked like; '' keeps nothing (``watched.py``)."""


def unsupported(spec: PolicySpec, mask: Array) -> UserError:
    """The error for a subset ``mask`` (V,) bool that a policy cannot act on."""
    return UserError(
        f"{spec.name} cannot act on {name_of(mask, spec.streams)!r}; "
        f"it was trained on: {', '.join(spec.trained_subsets) or 'none of these'}"
    )


def check_begin(begin: int, task: str, horizon: int) -> None:
    """Raises UserError where a condition begins at a step that no episode of ``task`` has.
    ``horizon`` 0: it is not known."""
    if begin and begin >= (horizon := horizon or env_spec(task).horizon):
        raise UserError(
            f"expected failures before step {horizon}, where {task} ends, found one at step "
            f"{begin}; choose an earlier one"
        )


def run_episode(
    policy: Policy,
    env: Environment,
    mask: Array,
    ablation: Ablation,
    seed: int,
    stop: Callable[[], bool] = lambda: False,
    watch: Watch = lambda *_: None,
    begin: int = 0,
) -> EpisodeResult:
    """Runs the episode ``seed`` on the subset ``mask`` (V,) bool, with the occlusions of
    ``ablation``, both from step ``begin`` on; cameras stand where ``env`` has them.

    Only cameras that are present are drawn, and of those that are occluded only the pictures that
    matter; dropped streams cannot reach the sum, so they may as well be black. ``watch`` sees every
    decision. Raises UserError if the policy cannot act on the subset, Stopped if ``stop`` says so
    between two decisions.
    """
    streams = policy.spec.streams
    every = np.ones_like(mask)
    intact = Ablation()
    for needed in (mask, every) if begin else (mask,):
        if not policy.supports(needed):
            raise unsupported(policy.spec, needed)
    check_begin(begin, env.spec.task, env.spec.horizon)
    stack = stack_of(policy.spec, env.spec)
    now = env.reset(seed)
    total = 0.0
    success_any = False
    decision = 0
    outside = 0
    with closing(player_of(policy, seed)) as player:
        while not now.last:
            if stop():
                raise Stopped
            check_state(now.state, env.spec)
            present = mask if decision >= begin else every
            fails = ablation if decision >= begin else intact
            cameras = dict.fromkeys(
                camera_of(s) for s, on in zip(streams, present, strict=True) if on
            )
            views = {
                camera: env.view(camera)
                for camera in cameras
                if fails.camera(camera).occlusion.looks(decision)
            }
            stack.push(views, fails, seed, decision)
            encoded = policy.encode(stack.views, now.state)  # (V, C, H, W) -> features (V, Z)
            action = player.act(encoded, present)  # (A,)
            outside += numbers_outside(action)
            watch(env, stack, encoded, action)
            now = env.step(action)
            total += float(now.reward)
            success_any |= bool(now.success)
            decision += 1
            check_ends(env.spec, decision, now.last)
        outside += getattr(player, "outside", 0)  # A player that clips has counted before.
    share = outside / max(decision * env.spec.action_dim, 1)
    ended = (bool(now.success), success_any, total, share, getattr(player, "noticed", None))
    return EpisodeResult(name_of(mask, streams), seed, *ended)


def clipped_words(share: float) -> str:
    """One sentence on ``share`` of the action numbers that lay outside [-1, 1]; '' for none."""
    if share <= 0:
        return ""
    return (
        f"{100 * share:.2g} % of the policy's action numbers lay outside [-1, 1] and were clipped: "
        "a policy that acts in other units is not measured here."
    )


class Runner:
    """Runs jobs in this process; keeps the last few policies and the last environment."""

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        self._stop = stop
        self._policies: dict[tuple[str, str], Policy] = {}
        self._env: tuple[tuple[Any, ...], Environment] | None = None
        self._moved: set[str] = set()
        """Cameras of that environment that may not stand where its spec has them."""

    def opened(self, job: Job) -> tuple[Environment, Policy]:
        """The environment and the policy of ``job``. The environment stays until a job needs
        another one."""
        policy = self._loaded(job.policy, job.digest)
        return self._environment(policy), policy

    def run(self, job: Job, watch: Watch = lambda *_: None) -> Finished:
        """Plays the job's episode, and shows every decision to ``watch``. Raises UserError if its
        policy's files changed meanwhile."""
        env, policy = self.opened(job)
        self._place(env, dict(job.condition.moves))
        condition = job.condition
        mask = condition.mask(policy.spec.streams)
        ablation = condition.ablation(policy.spec.streams)
        with one_thread():
            result = run_episode(
                policy, env, mask, ablation, job.seed, self._stop, watch, condition.begin
            )
        return result, definition_of(env.spec)

    def _place(self, env: Environment, moves: dict[str, Displacement]) -> None:
        """Every camera where the job has it, whatever the job before did."""
        for camera in sorted(self._moved | moves.keys()):
            move = moves.get(camera)
            self._moved.add(camera)  # Before the move: it counts as moved also if that fails.
            env.move_camera(camera, move.placed(env.spec.camera(camera)) if move else None)
        self._moved = set(moves)

    def adopt(self, reference: str, policy: Policy) -> None:
        """Makes an object that exists already answer to ``reference``."""
        self._policies[reference, policy.spec.digest] = policy

    def close(self) -> None:
        """Closes the environment."""
        if self._env:
            self._env[1].close()
        self._env = None
        self._moved = set()

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
        refuse_recording(policy.spec.task, "counting successes")
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
