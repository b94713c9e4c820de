"""Time steps of an episode as a policy gets them: pictures, features, actions of every subset.

``moments`` plays an episode and yields every time step; ``moment_at`` returns one of them:

    policy = madviz.load_policy("metaworld-hammer-mad-light")
    now = moment_at(policy, seed=2000, step=20)
    now.views["first"].rgb     (84, 84, 3)   what the camera sees
    now.stack                  (V, 9, 84, 84) what the network gets
    now.probe.norms            (V,)          the norm of every camera's feature
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from madviz.analysis.probes import Probe, probe
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Occlusion, noise_generator
from madviz.observation.condition import Condition
from madviz.policies.players import player_of
from madviz.subsets import camera_of, cameras_of, mask_of
from madviz.types import Array, EnvSpec, Policy, View

LESSON_SEED = 2000
"""Episodes of lessons start here: none of them is used for training, or reported on a card."""


def begin() -> None:
    """The first line of a lesson: pictures without a display, one thread for small networks.

    MuJoCo reads ``MUJOCO_GL`` while it is imported, and its own default needs a display.
    """
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    import torch

    torch.set_num_threads(1)


@dataclass(frozen=True)
class Moment:
    """One time step of an episode, and how ``policy`` acts at it."""

    policy: Policy
    env: EnvSpec
    views: dict[str, View]
    """The true picture of each camera."""
    arrived: dict[str, Array]
    """(H, W, C) uint8 by stream: what reached the policy, occlusions applied."""
    stack: Array
    """(V, 3 x frame stack, H, W) uint8: the network's input, oldest frame first."""
    state: Array
    """(S,) float32 proprioception."""
    step: int
    success: bool
    """The task's condition at this time step."""

    @cached_property
    def probe(self) -> Probe:
        """Features, and what every subset of them would do."""
        return probe(self.policy, self.policy.encode(self.stack, self.state))

    def row(self, subset: str) -> int:
        """The row of ``subset`` in ``probe``. Raises UserError for unknown words."""
        return self.probe.row(mask_of(subset, self.policy.spec.streams))

    def action(self, subset: str = "all") -> Array:
        """(A,) what the policy would do next if it had ``subset``."""
        return self.probe.readout.action[self.row(subset)]


def moments(
    policy: Policy,
    seed: int = LESSON_SEED,
    subset: str = "all",
    occlusions: Mapping[str, Occlusion] | None = None,
) -> Iterator[Moment]:
    """Plays the episode ``seed`` with the cameras of ``subset``, and yields all time steps with
    the last one. All cameras are drawn, so that a lesson can show what was not used.

    Raises UserError for unknown words and for a subset the policy cannot act on.
    """
    begin()
    spec = policy.spec
    mask = mask_of(subset, spec.streams)
    if not policy.supports(mask):
        raise UserError(f"{spec.name} cannot act on {subset!r}; pick a subset it supports")
    ablation = Condition(subset, tuple((occlusions or {}).items())).ablation(spec.streams)
    with (
        closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env,
        closing(player_of(policy, seed)) as player,
    ):
        stack = stack_of(spec, env.spec)
        now = env.reset(seed)
        step = 0
        while True:
            views = {camera: env.view(camera) for camera in cameras_of(spec.streams)}
            stack.push(views, ablation, seed, step)
            moment = Moment(
                policy=policy,
                env=env.spec,
                views=views,
                arrived=dict(stack.newest),
                stack=stack.views,
                state=np.asarray(now.state, np.float32),
                step=step,
                success=now.success,
            )
            yield moment
            if now.last:
                return
            encoded = policy.encode(moment.stack, moment.state)
            now = env.step(player.act(encoded, mask))
            step = step + 1


def moment_at(
    policy: Policy,
    seed: int = LESSON_SEED,
    step: int = 20,
    subset: str = "all",
    occlusions: Mapping[str, Occlusion] | None = None,
) -> Moment:
    """The time step after ``step`` decisions. Raises UserError for a step beyond the episode."""
    for moment in moments(policy, seed, subset, occlusions):
        if moment.step == step:
            return moment
    raise UserError(f"expected a step of the episode, found {step}; it is over before that")


def occluded(moment: Moment, occlusions: Mapping[str, Occlusion]) -> Moment:
    """The same time step as if cameras had failed during all frames of the stack, without an effect
    on the actions before. A frozen camera shows the oldest frame of the stack, and so does a late
    one: older frames are not there."""
    stack = moment.stack.copy()
    streams = moment.policy.spec.streams
    for index, stream in enumerate(streams):
        occlusion = occlusions.get(camera_of(stream), Occlusion())
        frames = frames_of(moment.stack, index)
        failed = [
            occlusion.apply(
                frames[max(place - occlusion.late, 0)],
                frames[0],
                noise_generator(0, moment.step + place, stream),
            )
            for place in range(len(frames))
        ]
        stack[index] = np.concatenate([np.moveaxis(frame, -1, 0) for frame in failed])
    newest = {stream: frames_of(stack, index)[-1] for index, stream in enumerate(streams)}
    return replace(moment, stack=stack, arrived=newest)


def frames_of(stack: Array, stream: int) -> list[Array]:
    """The colour frames (H, W, 3) of one stream in a stack (V, C, H, W), oldest first."""
    return [np.moveaxis(part, 0, -1) for part in np.split(stack[stream], len(stack[stream]) // 3)]
