"""The score of an episode while it is played: reward, success, and failures of cameras.

An outcome is put beside others of the same condition, so an episode whose decisions were taken
under several has none: ``Outcome.condition`` is None. What is done to a camera before the first
decision, or after the last, or is undone before the next, is seen by no decision and counts
nowhere.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from madviz.observation.ablation import Ablation
from madviz.observation.condition import Condition
from madviz.session.frame import Outcome
from madviz.types import PolicySpec, TimeStep


@dataclass
class EpisodeRecord:
    """The score of one episode so far."""

    total_reward: float = 0.0
    success_any: bool = False
    conditions: set[tuple[PolicySpec, Condition]] = field(default_factory=set)
    """All that a decision was taken under, with the policy."""
    worst: dict[str, str] = field(default_factory=dict)
    """By camera: off, occluded or moved, the first of these that it was at any decision."""

    def arrived(self, time_step: TimeStep) -> None:
        """Counts a decision's reward and success."""
        self.total_reward += time_step.reward
        self.success_any |= time_step.success

    def note(self, policy: PolicySpec, condition: Condition, ablation: Ablation) -> None:
        """Notes the condition under which a decision was taken."""
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

    def outcome(
        self, spec: PolicySpec, seed: int, success: bool, cameras: Iterable[str]
    ) -> Outcome:
        """The result of the episode, which has ended."""
        only = next(iter(self.conditions))[1] if len(self.conditions) == 1 else None
        return Outcome(
            policy=spec,
            seed=seed,
            success=success,
            success_any=self.success_any,
            total_reward=self.total_reward,
            cameras={camera: self.worst.get(camera, "") for camera in cameras},
            condition=only,
        )

    def copy(self) -> EpisodeRecord:
        """For ``Snapshot``: what happens later does not change it."""
        return EpisodeRecord(
            self.total_reward, self.success_any, set(self.conditions), dict(self.worst)
        )
