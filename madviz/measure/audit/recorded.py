"""``madviz audit --recording DATASET``: what a policy's action owes to each camera, open loop.

The policy answers to every chosen step of recorded episodes, with all cameras and with every camera
removed, alone and broken. Nobody follows its answers, so there is no success: what is measured is
how far its action moves from its action with all cameras, and from the recorded one, in spreads of
the recorded actions (``Robot.distance``).

    change of a condition    mean over steps of |a(condition) - a(all)|
    interval                 Student's t over episodes

Steps of one episode resemble each other, so 5 episodes say as much as 5, not as 500 steps. A policy
may know the answers of an episode that it was trained on: such episodes show where a camera
matters, and no verdict rests on them, nor a distance where there are others. The verdict on a
camera rests on the change without it: below ``HARDLY`` with the whole interval, above it, or not
decided.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from madviz.errors import UserError
from madviz.measure.audit.lost_cameras import INTACT, AuditRow, Cameras, How, What
from madviz.measure.episodes import one_thread
from madviz.measure.formulas import t_interval
from madviz.measure.mean_picture import recorded_means
from madviz.observation.condition import Condition
from madviz.observation.streams import MeanPictures, StreamStack
from madviz.recorded.known import LABEL
from madviz.recorded.moment import RecordedState
from madviz.recorded.recordings import Recordings
from madviz.recorded.robot import Robot
from madviz.recorded.scaling import each_apart
from madviz.types import Array, EnvSpec, Policy, View

HARDLY = 0.1
"""Spreads; an action that changes less hardly changes."""
STEPS = 100
"""Steps of an episode at which the policy is asked, evenly spaced."""
MOMENTS = 3
"""Steps that are named for each camera, each of another episode."""
CHANGES = "its action changes without it"
STAYS = "its action hardly changes without it"
OPEN = "not decided"
VERDICTS = {
    CHANGES: f"the interval of the change without it lies above {HARDLY} spreads",
    STAYS: f"the interval of the change without it lies below {HARDLY} spreads",
    OPEN: "the interval holds both, there is one episode alone, or the policy was trained on all: "
    "more episodes may tell",
}


class DistanceRow(TypedDict):
    """A mean distance in spreads, over episodes."""

    mean: float
    ci95: list[float] | None
    """Student's t over episodes; None for a single one."""


class RecordedRow(TypedDict):
    """One condition."""

    camera: str | None
    what: What
    how: How
    change: DistanceRow
    """From the action with all cameras."""
    further: DistanceRow
    """Its distance from the recorded action, less that with all cameras."""
    most: str
    """The number of the action that changes most; '' where none does."""
    most_apart: float
    """Its change, in its own spread."""


class CameraStep(TypedDict):
    """A step at which a camera mattered."""

    camera: str
    episode: int
    place: int
    """The episode's among all; the page calls it number."""
    step: int
    change: float


class RecordedAuditFile(TypedDict):
    """audit.json of recordings."""

    schema: int
    label: str
    """``recorded: actions change nothing``."""
    policy: str
    task: str
    digest: str
    recording: str
    fps: float
    labels: dict[str, str]
    episodes: list[int]
    judged: list[int]
    """Those among them that verdicts and distances rest on; none: no verdict, and all distances."""
    training_known: bool
    """True where it is known what the policy was trained on: on all that are not judged."""
    steps: int
    """Answers for each condition."""
    apart: DistanceRow
    """From the recorded action, with all cameras."""
    repeats: DistanceRow
    """Between two answers to the same look with all cameras: 0, but for a policy that samples."""
    conditions: list[RecordedRow]
    verdict: dict[str, str]
    decided_by: dict[str, How]
    moments: list[CameraStep]
    left_out: list[str]


@dataclass(frozen=True)
class RecordedAudit:
    """A policy, and the recordings that it answers to."""

    policy: Policy
    robot: Robot
    recordings: Recordings
    env: EnvSpec
    how: tuple[How, ...]

    @property
    def cameras(self) -> Cameras:
        return Cameras(self.policy.spec.streams, self.policy.supports, self.how)

    @property
    def conditions(self) -> list[Condition]:
        """All that are different, the one with all cameras first."""
        rows = [row.condition for row in self.cameras.rows()]
        return list(dict.fromkeys([INTACT, *rows]))

    def chosen(self, most: int | None) -> list[int]:
        """The indices of the episodes to answer to: those that the policy was not trained on, if
        there are any; with ``most``, that many, and the others after them."""
        known = [one.index for one in self.recordings.episodes]
        unseen = self.robot.unseen(self.recordings)
        if most is None:
            return list(unseen or known)
        return [*unseen, *(index for index in known if index not in unseen)][:most]

    def answers(self, index: int, steps: Array, means: MeanPictures) -> Array:
        """(N + 1, T', A) scaled actions at ``steps`` of an episode, under each of ``conditions``.
        The last row is with all cameras once more."""
        spec = self.policy.spec
        names = [camera.name for camera in self.recordings.cameras]
        frames = self.recordings.frames(index, spec.image_size)  # (T, V, H, W, 3)
        raw = self.recordings.numbers(index)[0]  # (T, S)
        states = self.robot.states.scale(raw)
        task = next(one.task for one in self.recordings.episodes if one.index == index)
        groups: dict[object, list[int]] = defaultdict(list)
        for row, condition in enumerate(self.conditions):
            groups[condition.occlusions].append(row)
        width = len(self.robot.action_names)
        actions = np.zeros((len(self.conditions) + 1, len(steps), width), np.float32)
        place = {int(step): number for number, step in enumerate(steps)}
        depth = np.ones(frames.shape[2:4], np.float32)  # Nothing looks at it.
        for rows in groups.values():
            stack = StreamStack(
                self.env, spec.streams, spec.frame_stack, spec.image_size, lambda: means
            )
            ablation = self.conditions[rows[0]].ablation(spec.streams)
            masks = np.stack([self.conditions[row].mask(spec.streams) for row in rows])  # (N', V)
            for step in range(int(steps[-1]) + 1):
                pictures = np.array(frames[step])
                views = {name: View(pictures[names.index(name)], depth) for name in spec.streams}
                stack.push(views, ablation, index, step)
                if step in place:
                    state = RecordedState.of(states[step], raw[step], task)
                    encoded = self.policy.encode(stack.views, state)
                    actions[rows, place[step]] = self.policy.read(encoded, masks).action
                    if 0 in rows:  # A served policy keeps its answers with what was encoded.
                        again = self.policy.encode(stack.views, state)
                        actions[-1, place[step]] = self.policy.read(again, masks[:1]).action[0]
        return actions


@dataclass(frozen=True, eq=False)
class _Answered:
    """The answers to one episode, N conditions at T' steps."""

    steps: Array
    """(T',)."""
    change: Array
    """(N, T') from the action with all cameras."""
    repeats: Array
    """(T',) between two actions with all cameras."""
    numbers: Array
    """(N, A): likewise, of each number, on average over the steps."""
    errors: Array
    """(N,) distance from the recorded action, on average over the steps."""


def recorded_audit(
    audit: RecordedAudit, most: int | None = None, progress: bool = False
) -> RecordedAuditFile:
    """The document of ``audit`` on the episodes that its policy was not trained on, or on ``most``
    episodes. Raises UserError if none can be decoded and answered, and for recordings of which no
    action changes."""
    if not audit.robot.scaled_spread.any():
        raise UserError(
            f"{audit.recordings.path}: expected actions that change, found none; record others"
        )
    spec = audit.policy.spec
    means, faults = recorded_means(audit.recordings, spec.streams, spec.image_size)
    answered: dict[int, _Answered] = {}
    left_out = [*audit.recordings.left_out, *faults]
    chosen = audit.chosen(most)
    for number, index in enumerate(chosen, start=1):
        recorded = audit.robot.actions.scale(audit.recordings.numbers(index)[1])  # (T, A)
        steps = np.unique(np.linspace(0, len(recorded) - 1, STEPS).round().astype(int))
        try:
            with one_thread():
                asked = audit.answers(index, steps, means)  # (N + 1, T', A)
            if not np.isfinite(asked).all():
                raise UserError("expected finite actions, found others; see madviz serve --check")
        except UserError as error:
            left_out.append(f"episode {index}: {error}")
            continue
        actions = asked[:-1]
        answered[index] = _Answered(
            steps,
            audit.robot.distance(actions, actions[:1]),
            audit.robot.distance(asked[-1], actions[0]),
            each_apart(actions, actions[:1], audit.robot.scaled_spread).mean(axis=1),
            audit.robot.distance(actions, recorded[steps]).mean(axis=1),
        )
        if progress:
            print(f"{number} of {len(chosen)} episodes", file=sys.stderr)
    if not answered:
        raise UserError(f"expected an episode that can be decoded, found none: {left_out[-1]}")
    return _document(audit, answered, list(dict.fromkeys(left_out)))


def _document(
    audit: RecordedAudit, answered: dict[int, _Answered], left_out: list[str]
) -> RecordedAuditFile:
    spec = audit.policy.spec
    robot = audit.robot
    place = {condition: row for row, condition in enumerate(audit.conditions)}
    unseen = robot.unseen(audit.recordings)
    judged = [index for index in answered if index in unseen]
    episodes = [answered[index] for index in judged or answered]
    changes = np.stack([one.change.mean(axis=1) for one in episodes], axis=1)  # (N, E)
    repeats = np.array([one.repeats.mean() for one in episodes])  # (E,)
    errors = np.stack([one.errors for one in episodes], axis=1)  # (N, E)
    numbers = np.mean([one.numbers for one in episodes], axis=0)  # (N, A)

    def row(one: AuditRow) -> RecordedRow:
        at = place[one.condition]
        most = int(numbers[at].argmax())
        return {
            "camera": one.camera,
            "what": one.what,
            "how": one.how,
            "change": distance_row(changes[at]),
            "further": distance_row(errors[at] - errors[0]),
            "most": robot.action_names[most] if numbers[at, most] > 0 else "",
            "most_apart": float(numbers[at, most]),
        }

    deciding = {name: audit.cameras.deciding(name).removed for name in audit.cameras.names}
    verdicts = {}
    for name, one in deciding.items():
        at = place[one.condition]
        sampled = None
        if repeats.any():
            # Of independent noise the squares add up, so that they can be taken apart.
            sampled = np.array(
                [(e.change[at] ** 2).mean() - (e.repeats**2).mean() for e in episodes]
            )
        verdicts[name] = verdict(distance_row(changes[at]), sampled)
    return {
        "schema": 1,
        "label": LABEL,
        "policy": spec.name,
        "task": spec.task,
        "digest": spec.digest,
        "recording": audit.recordings.name,
        "fps": audit.recordings.fps,
        "labels": {name: audit.env.camera(name).label for name in audit.cameras.names},
        "episodes": list(answered),
        "judged": judged,
        "training_known": bool(robot.trained_on),
        "steps": sum(len(one.steps) for one in answered.values()),
        "apart": distance_row(errors[0]),
        "repeats": distance_row(repeats),
        "conditions": [row(one) for one in audit.cameras.rows()],
        "verdict": verdicts if judged else dict.fromkeys(verdicts, OPEN),
        "decided_by": {name: one.how for name, one in deciding.items()},
        "moments": _moments(audit, answered),
        "left_out": left_out,
    }


def _moments(audit: RecordedAudit, answered: dict[int, _Answered]) -> list[CameraStep]:
    """For each camera, the steps at which the action changes most without it, one of an episode."""
    known = [one.index for one in audit.recordings.episodes]
    moments: list[CameraStep] = []
    for name in audit.cameras.names:
        row = audit.conditions.index(audit.cameras.deciding(name).removed.condition)
        found: list[CameraStep] = []
        for index, one in answered.items():
            best = int(one.change[row].argmax())
            found.append(
                {
                    "camera": name,
                    "episode": index,
                    "place": known.index(index),
                    "step": int(one.steps[best]),
                    "change": float(one.change[row, best]),
                }
            )
        moments += sorted(found, key=lambda moment: -moment["change"])[:MOMENTS]
    return moments


def distance_row(values: Sequence[float] | Array) -> DistanceRow:
    """The mean of one number for each episode, with its interval."""
    values = np.asarray(values, np.float64)
    if len(values) < 2:
        return {"mean": float(values.mean()), "ci95": None}
    return {"mean": float(values.mean()), "ci95": list(t_interval(values))}


def verdict(change: DistanceRow, beyond: Array | None = None) -> str:
    """The words for a camera, by the change without it. ``beyond`` (E,), of a policy that samples:
    the mean square of the change in each episode, less that of two answers to the same look."""
    if change["ci95"] is None:
        return OPEN
    low, high = change["ci95"]
    if high < HARDLY:
        return STAYS
    if low <= HARDLY or (beyond is not None and t_interval(beyond)[0] <= HARDLY**2):
        return OPEN
    return CHANGES
