"""The snapshot of a step that a simulation keeps: enough to show it, and to go on from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from madviz.analysis.probes import Probe
from madviz.guard.policy import GuardReport
from madviz.observation.ablation import Ablation
from madviz.recorded.moment import RecordedMoment, moment_of
from madviz.session.episode_record import EpisodeRecord
from madviz.session.journal import Mark
from madviz.session.playing import Look
from madviz.types import (
    Array,
    Body,
    CameraPose,
    Encoded,
    Environment,
    Policy,
    ResetsInPieces,
    TimeStep,
    View,
)


@dataclass(frozen=True)
class StepData:
    """The result of one step: everything that does not depend on the ablation."""

    time: TimeStep
    step: int
    views: dict[str, View]
    poses: dict[str, CameraPose]
    bodies: tuple[Body, ...]
    body_poses: Array
    hand: Array
    recorded: RecordedMoment | None = None

    @classmethod
    def first(cls, env: Environment, seed: int, between: Callable[[], None]) -> StepData:
        """The first step of ``seed``. ``between`` is called as in ``drawn``, and during a reset in
        pieces."""
        pieces = isinstance(env, ResetsInPieces)
        time = env.reset_in_pieces(seed, between) if pieces else env.reset(seed)
        return cls.drawn(env, time, 0, between)

    @classmethod
    def drawn(
        cls, env: Environment, time: TimeStep, step: int, between: Callable[[], None]
    ) -> StepData:
        """All that ``env`` has to show of a step, with every camera, always: one that comes back
        needs its past frames. ``between`` is called after every camera."""
        views = dict[str, View]()
        for camera in env.spec.cameras:
            views[camera.name] = env.view(camera.name)  # (H, W, 3)
            between()
        poses = {camera.name: env.pose(camera.name) for camera in env.spec.cameras}
        scene = (env.bodies(), env.body_poses(), env.hand())
        return cls(time, step, views, poses, *scene, moment_of(env))

    def redrawn(self, env: Environment, camera: str) -> StepData:
        """The same step, with ``camera`` where it is now."""
        views = {**self.views, camera: env.view(camera)}
        poses = {**self.poses, camera: env.pose(camera)}
        return replace(self, views=views, poses=poses)


@dataclass(frozen=True)
class InputState:
    """A policy's input at a step; its fields are those of ``PolicyInput``."""

    stack: tuple
    encoded: Encoded
    used: Encoded
    guard: GuardReport | None
    probe: Probe
    unread: bool


@dataclass(frozen=True)
class Snapshot:
    """A step of an episode, with all that it takes to go on from it; pictures are shared."""

    actions: tuple[Array, ...]
    """The actions that led here from the start."""
    recent: tuple[StepData, ...]
    policy: Policy
    looks: tuple[Look, ...]
    """The inputs that the policy acted on so far, where it remembers."""
    input: InputState
    ablation: Ablation
    record: EpisodeRecord
    mark: Mark
