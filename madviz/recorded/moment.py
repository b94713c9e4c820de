"""One moment of a recording, beside what any environment says of a step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from madviz.types import Array


class RecordedState(np.ndarray):
    """A scaled state (S,) that carries what was recorded with it, for a policy that is served. What
    is computed from it carries nothing."""

    raw: Array | None = None
    """(S,) float32 in the robot's units."""
    task: str | None = None
    """The episode's task in words."""

    @classmethod
    def of(cls, scaled: Array, raw: Array, task: str) -> RecordedState:
        """``scaled`` (S,) float32 with ``raw`` (S,) and ``task``."""
        state = scaled.view(cls)
        state.raw = raw
        state.task = task
        return state


@dataclass(frozen=True)
class RecordedMoment:
    """A moment of a recording."""

    action: Array
    """(A,) float32 the recorded action; beyond [-1, 1] where training has none so large."""
    episode: int
    """The episode's number in its dataset."""
    task: str
    """The episode's task in words."""
    decisions: int
    """Decisions in the episode."""


def moment_of(env: object) -> RecordedMoment | None:
    """The recording at this step, which an environment that shows one tells by ``recorded()``;
    None where ``env`` is a simulator."""
    recorded = getattr(env, "recorded", None)
    return recorded() if recorded else None
