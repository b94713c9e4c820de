"""The score of an episode while it is played: reward, success, and failures of cameras.

An outcome is put beside others of the same condition, so an episode whose decisions were taken
under several has none: ``Outcome.condition`` is None. What is done to a camera before the first
decision, or after the last, or is undone before the next, is seen by no decision and counts
nowhere.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from madviz.observation.ablation import Ablation
from madviz.observation.condition import Condition
from madviz.session.frame import Deed, Outcome
from madviz.subsets import camera_of
from madviz.types import CameraSpec, Policy, PolicySpec, PolicyWithMemory, TimeStep

WORST = {"off": "was dropped", "occluded": "was broken", "moved": "stood elsewhere"}
"""The words for a camera that is as in training again, by the worst that it was."""


@dataclass
class EpisodeRecord:
    """The score of one episode so far."""

    total_reward: float = 0.0
    success_any: bool = False
    conditions: set[tuple[PolicySpec, Condition]] = field(default_factory=set)
    """All that a decision was taken under, with the policy."""
    worst: dict[str, str] = field(default_factory=dict)
    """By camera: off, occluded or moved, the first of these that it was at any decision."""
    decisions: int = 0
    since: dict[str, tuple[str, int]] = field(default_factory=dict)
    """By camera that is not as in training: how, in words, and since which decision."""
    last: Condition | None = None
    """The one of the last decision."""
    remembers_all: bool = True
    """False where the policy, or its guard, has a memory that began after the first decision."""

    def arrived(self, time_step: TimeStep) -> None:
        """Counts a decision's reward and success."""
        self.total_reward += time_step.reward
        self.success_any |= time_step.success

    def note(self, policy: PolicySpec, condition: Condition, ablation: Ablation) -> None:
        """Notes the condition under which a decision was taken. A camera that the policy does not
        use counts nowhere."""
        ablation = ablation.of([camera_of(stream) for stream in policy.streams])
        self.conditions.add((policy, condition))
        present = ablation.present(policy.streams)
        occluded = ablation.occlusions()
        for camera in (*ablation.cameras, *ablation.moves):
            if camera not in present:
                self.worst[camera] = "off"
            elif camera in occluded and self.worst.get(camera) != "off":
                self.worst[camera] = "occluded"
            elif camera in ablation.moves:
                self.worst.setdefault(camera, "moved")
        past = {
            camera: f"{WORST['moved']} ({move.words()})"
            for camera, move in ablation.moves.items()
            if camera in present
        }
        past |= {camera: how.past for camera, how in occluded.items() if camera in present}
        past |= {camera: WORST["off"] for camera in ablation.cameras if camera not in present}
        before = self.since
        self.since = {
            camera: before[camera] if before.get(camera, ("",))[0] == how else (how, self.decisions)
            for camera, how in past.items()
        }
        self.last = condition
        self.decisions += 1

    def swapped(self, policy: Policy) -> None:
        """``policy`` acts from here on."""
        if self.decisions and isinstance(policy, PolicyWithMemory):
            self.remembers_all = False

    def deeds(self, cameras: Iterable[CameraSpec]) -> tuple[Deed, ...]:
        """The change of each of ``cameras``, in words."""
        return tuple(
            Deed(camera.label, *self.since.get(camera.name, (WORST[self.worst[camera.name]], None)))
            for camera in cameras
            if camera.name in self.worst
        )

    def outcome(
        self, spec: PolicySpec, seed: int, success: bool, cameras: Iterable[CameraSpec]
    ) -> Outcome:
        """The result of the episode, which has ended."""
        cameras = list(cameras)
        whole = self.remembers_all and len(self.conditions) == 1
        only = next(iter(self.conditions))[1] if whole else None
        return Outcome(
            policy=spec,
            seed=seed,
            success=success,
            cameras={camera.name: self.worst.get(camera.name, "") for camera in cameras},
            condition=only,
            last=self.last,
            deeds=self.deeds(cameras),
            alone=len({policy for policy, _ in self.conditions}) <= 1,
        )

    def copy(self) -> EpisodeRecord:
        """For ``Snapshot``: what happens later does not change it."""
        return replace(self, conditions=set(self.conditions), worst=dict(self.worst))
