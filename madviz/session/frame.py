"""The frames that come out of a session, all frozen, and the words for what changed.

A page never touches a simulation. It sends commands (``commands.py``); it gets a ``Frame``, a
complete picture of one time step that nobody changes afterwards, so that no lock is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from madviz.analysis.foresight import Foresight
from madviz.analysis.imagination import Imagined
from madviz.analysis.probes import Probe
from madviz.analysis.saliency import Target
from madviz.guard.policy import GuardReport
from madviz.observation.ablation import Ablation, CameraState
from madviz.observation.condition import Condition
from madviz.observation.schedule import Schedule
from madviz.recorded.moment import RecordedMoment
from madviz.subsets import camera_of, mask_of, modality_of
from madviz.types import Array, Body, CameraPose, EnvSpec, PolicySpec, View

Phase = Literal["playing", "paused", "ended"]
Reading = tuple[Condition, Array, float]
"""A condition, and the action (A,) and Q under it."""


@dataclass(frozen=True)
class Change:
    """A visitor's last change to a camera, and its effect at that time step."""

    camera: str
    before: CameraState
    after: CameraState
    condition_before: Condition
    condition_after: Condition
    action_change: float
    """Euclidean distance between the two actions."""
    q_before: float
    q_after: float
    moved: str = ""
    """Where the camera went, in words, if that is what was done."""
    acts: bool = True
    """True where the policy can act after it."""

    @classmethod
    def between(
        cls,
        camera: str,
        states: Sequence[CameraState],
        readings: tuple[Reading, Reading],
        moved: str = "",
    ) -> Change:
        """The change of ``camera`` from the first of ``states`` to the second, and ``readings``
        before and after it."""
        (condition_before, action_before, q_before), (condition, action, q) = readings
        apart = float(np.linalg.norm(action - action_before))
        before, after = states
        acts = bool(np.isfinite(action).all())
        pair = (condition_before, condition)
        return cls(camera, before, after, *pair, apart, q_before, q, moved, acts)


class Deed(NamedTuple):
    """A change of one camera in an episode that is over."""

    label: str
    """The camera's."""
    past: str
    """In words: ``was dropped``, ``sent black``."""
    step: int | None
    """The first decision that was taken so, of all that followed; None: not until the end."""


@dataclass(frozen=True)
class Outcome:
    """How a live episode ended."""

    policy: PolicySpec
    """Who acted at the end."""
    seed: int
    success: bool
    """At the last step."""
    cameras: dict[str, str]
    """By camera: ``''`` if all was well at every decision, else the worst of ``off``, ``occluded``,
    ``moved``."""
    condition: Condition | None
    """The condition, if it and the policy were the same for all decisions."""
    last: Condition | None = None
    """The condition of the last decision."""
    deeds: tuple[Deed, ...] = ()
    """The cameras that were not as in training, in the order of the environment."""
    alone: bool = True
    """No other policy took a decision."""


Side = tuple[PolicySpec, Condition | None]
"""One side of a comparison: who acted, and under which condition."""


@dataclass(frozen=True)
class Pair:
    """How one seed ended on both sides of a comparison, each under one condition."""

    first: Outcome
    second: Outcome

    @property
    def sides(self) -> tuple[Side, Side]:
        """The two that were compared, A and B."""
        first = self.first
        second = self.second
        return (first.policy, first.condition), (second.policy, second.condition)


class TimelinePoint(NamedTuple):
    """The part of one step that a timeline draws."""

    q: float
    reward: float
    """In a recording: the distance between the policy's action and the recorded one."""
    success: bool
    condition: Condition
    policy: str
    last: bool
    """True if the episode ended there."""


@dataclass(frozen=True)
class Branch:
    """The future that an episode had before it was forked."""

    at: int
    """The step both futures share last."""
    history: tuple[TimelinePoint, ...]
    frame: Frame
    """At the same step as the frame that holds this branch, or at the branch's last one."""


APART = 0.01
"""Metres between two paths from which on they are said to differ; a grip shifts by less."""


@dataclass(frozen=True, eq=False)
class HandPaths:
    """The hand's path in an episode from the first change of a camera on, and its path in the same
    episode with all cameras; both begin at the same place."""

    since: int
    """The step at which they begin."""
    taken: Array
    """(T, 3) float32 metres, world frame: the path of the episode."""
    intact: Array
    """(S, 3) likewise, with all cameras."""

    @property
    def apart(self) -> Array:
        """(min(T, S),) metres between the two, step by step."""
        both = min(len(self.taken), len(self.intact))
        return np.linalg.norm(self.taken[:both] - self.intact[:both], axis=1)

    @property
    def largest(self) -> float:
        """Metres."""
        return float(self.apart.max())

    @property
    def differ_at(self) -> int | None:
        """The first step at which they are ``APART``; None where there is none."""
        steps = np.flatnonzero(self.apart >= APART)
        return self.since + int(steps[0]) if len(steps) else None


@dataclass(frozen=True)
class NoFrame:
    """There is no frame to show, for a simulation could not be started or drawn."""

    error: str
    title: str = "The simulator could not start."
    passing: bool = False
    """Whether the next frame ends it."""


@dataclass(frozen=True)
class World:
    """One time step of a simulation: policy, environment and what they make of each other."""

    env: EnvSpec
    policy: PolicySpec
    episode: int
    seed: int
    step: int
    """Decisions taken in this episode."""
    ablation: Ablation
    views: dict[str, View]
    """The true picture of each camera."""
    arrived: dict[str, Array]
    """(H, W, C) uint8 by stream: what reached the policy, occlusions applied."""
    poses: dict[str, CameraPose]
    bodies: tuple[Body, ...]
    """The bodies of the scene; the same object as in the frame before, unless it holds others
    now."""
    body_poses: Array
    """(N, 7) float32: position in metres and wxyz in the world, in the order of ``bodies``."""
    hand: Array
    """(3,) float32 metres, world frame: the middle between the gripper's fingertips."""
    probe: Probe
    planned: int
    """Decisions that the policy has settled already; cameras count again at the one after."""
    reward: float
    total_reward: float
    success: bool
    """The task's condition at this very step."""
    success_any: bool
    last: bool
    """True if the episode ends at this step; some tasks end at their first success."""
    change: Change | None
    """The last thing done to a camera in this episode."""
    outcomes: tuple[Outcome, ...]
    """The last live episodes, oldest first."""
    imagined: dict[str, Imagined] = field(default_factory=dict)
    """By stream that is not present: what the policy draws in its place, if it can."""
    foresees: bool = False
    """Whether the policy can imagine the decisions to come."""
    guard: GuardReport | None = None
    """The report of the policy's guard on this step; None where it has none."""
    recorded: RecordedMoment | None = None
    """The recording at this step; None in a simulator."""
    reference: str = ""
    """The name by which the session's ``load_policy`` finds the policy; its own name does not say
    that: a training of one's own is called like the shipped policy with the same task, method and
    recipe. '' where no session shows it."""


@dataclass(frozen=True)
class SessionPace:
    """Whether and how fast a session runs."""

    number: int
    """Grows with every frame of a session."""
    phase: Phase
    speed: float | None
    """Decisions per second asked for; None: as fast as it goes."""
    rate: float
    """Decisions per second achieved; NaN until there are enough to tell."""
    auto_next: bool
    reads_all: bool = False
    """Whether every subset is read where each costs a pass."""
    waited: float = 0.0
    """Seconds for which the policy has been asked for its decision, where that is felt; switches
    are shown as they will be then."""
    error: str = ""
    """Traceback or one line; the session has paused because of it."""


@dataclass(frozen=True)
class Frame:
    """One time step of one session, complete."""

    world: World
    pace: SessionPace
    history: tuple[TimelinePoint, ...] = ()
    """By step, all of this episode so far, also where an earlier step of it is shown."""
    branch: Branch | None = None
    second: Frame | None = None
    """B's side, at the same step."""
    linked: bool = True
    """Whether what is done to A's cameras is done to B's, too."""
    pairs: tuple[Pair, ...] = ()
    """The last seeds that A and B both finished."""
    schedule: Schedule = ()
    """Failures that come by themselves."""
    saliency: dict[str, Array] | None = None
    """(H, W) in [0, 1] by stream: where the policy looks, half a second old at most while an
    episode runs; None where nobody asked or there is none."""
    explained: Target | None = None
    """The target whose pixels somebody asked to see; there may be no ``saliency`` of it yet."""
    foresight: Foresight | None = None
    """The policy's imagination of the decisions after an earlier step or this one."""
    paths: HandPaths | None = None
    """After an episode in which a camera was changed, once its replay with all cameras is done."""

    @property
    def mask(self) -> Array:
        """(V,) bool: the streams that are present, and that a guard does not leave out."""
        mask = self.world.ablation.mask(self.world.policy.streams)
        return mask if self.world.guard is None else mask & self.world.guard.mask

    @property
    def row(self) -> int:
        """The row of the current subset in ``probe``."""
        return self.world.probe.row(self.mask)

    @property
    def trained_rows(self) -> frozenset[int]:
        """The rows of ``probe`` that the policy was trained to work from, as its card says."""
        spec = self.world.policy
        masks = (mask_of(name, spec.streams) for name in spec.trained_subsets)  # (V,) each
        return frozenset(map(self.world.probe.row, masks))

    @property
    def action(self) -> Array:
        """(A,): the policy's next action."""
        return self.world.probe.readout.action[self.row]  # (N, A) -> (A,)

    @property
    def q(self) -> float:
        return float(self.world.probe.readout.q[self.row])  # (N,) -> one number

    @property
    def condition(self) -> Condition:
        return Condition.of(self.world.ablation, self.world.policy.streams)

    @property
    def ended(self) -> bool:
        return self.world.last

    @property
    def decisions(self) -> int:
        """Decisions in this episode."""
        recorded = self.world.recorded
        return recorded.decisions if recorded else self.world.env.horizon

    @property
    def past(self) -> bool:
        """Whether this is an earlier step of the episode, shown again."""
        return self.world.step < len(self.history) - 1

    @property
    def behind(self) -> bool:
        """Whether the machine cannot keep the speed that was asked for."""
        return self.pace.speed is not None and bool(self.pace.rate < 0.9 * self.pace.speed)

    def camera(self, name: str) -> CameraState:
        """The state of a camera as a visitor would say it: a policy that knows one modality has
        cameras in that modality, not in ``both``, unless somebody asked for both."""
        if name in self.world.ablation.cameras:
            return self.world.ablation.camera(name)
        return untouched(self.world.policy)

    def uses(self, name: str) -> bool:
        """Whether anything of a camera reaches the policy."""
        pairs = zip(self.world.policy.streams, self.mask, strict=True)
        return any(on and camera_of(stream) == name for stream, on in pairs)


def untouched(policy: PolicySpec) -> CameraState:
    """The state of a camera nobody has touched, under ``policy``."""
    known = {modality_of(stream) for stream in policy.streams}
    return CameraState("both" if len(known) > 1 else "depth" if "depth" in known else "rgb")


def carried(ablation: Ablation, old: PolicySpec, new: PolicySpec) -> Ablation:
    """``ablation`` of the policy ``old`` for ``new``: a camera that is as in training stays so,
    also where one policy takes its depth and the other does not."""
    before = untouched(old)
    after = untouched(new)
    cameras = {name: after if at == before else at for name, at in ablation.cameras.items()}
    return Ablation(cameras, ablation.moves)


def words(change: Change, env: EnvSpec) -> str:
    """``Third A dropped: action changed by 0.31, Q 12.1 → 9.8``."""
    effect = action_words(change)
    if np.isfinite([change.q_before, change.q_after]).all():
        effect += f", Q {change.q_before:.1f} → {change.q_after:.1f}"
    return f"{deed(change, env)}: {effect}"


def action_words(change: Change, side: str = "") -> str:
    """``action changed by 0.31``, or ``this policy cannot act on that``. ``side``: whose it is,
    where there are two."""
    if not np.isfinite(change.action_change):
        can = "can act again" if change.acts else "cannot act on that"
        return f"{side or 'this policy'} {can}"
    return f"{side}'s " * bool(side) + f"action changed by {change.action_change:.2f}"


def deed(change: Change, env: EnvSpec) -> str:
    """``Third A dropped``."""
    done = change.moved or _deed(change.before, change.after)
    return f"{env.camera(change.camera).label} {done}"


def _deed(before: CameraState, after: CameraState) -> str:
    occluded = before.input == after.input and before.occlusion != after.occlusion
    if after.input == "off" and not occluded:
        return "dropped"
    if before.input == after.input:
        return after.occlusion.predicate
    if before.input == "off":
        return "is back" if after.occlusion.kind == "none" else after.occlusion.predicate
    return {"rgb": "gives colour", "depth": "gives depth", "both": "gives colour and depth"}[
        after.input
    ]
