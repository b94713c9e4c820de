"""The facts of a recording, and its frames in words; all writers use these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from madviz.session.camera_names import subset_label
from madviz.session.frame import Frame
from madviz.session.guard_words import failing


@dataclass(frozen=True)
class Facts:
    """The facts of a recording."""

    command: str
    """Makes it again."""
    failures: tuple[str, ...]
    """The failures of cameras, in the language of schedules."""
    fps: float = 10.0
    """Decisions in a second of film."""
    tile: int = 252
    """Pixels that a camera's picture is wide in a film."""
    policies: str = ""
    """Those that acted, and from which step on, where they are several."""


class Writer(Protocol):
    """Takes the frames of one episode, one for every step, in order."""

    def add(self, frame: Frame) -> None:
        """Takes the frame of the next step."""
        ...

    def close(self) -> None:
        """Completes the file."""
        ...


def headline(frame: Frame, facts: Facts) -> str:
    """Policy, task, seed and failures in one line."""
    failing = f" · fails: {', '.join(facts.failures)}" if facts.failures else ""
    who = facts.policies or frame.world.policy.name
    return f"{who} · {frame.world.env.task} · seed {frame.world.seed}{failing}"


def condition_words(frame: Frame) -> str:
    """Which cameras count, and which fail how: ``First person + Third B, First person is frozen``;
    with a guard, ``all, Third A sends black and is left out``."""
    failed = failing(frame)
    parts = [subset_label(frame, frame.condition.subset)]
    for name, occlusion in sorted(frame.world.ablation.occlusions().items()):
        said = f"{frame.world.env.camera(name).label} {occlusion.predicate}"
        if frame.uses(name):
            parts.append(said)
        elif name in failed:
            parts.append(f"{said} and is left out")
    return ", ".join(parts)


def verdict(frame: Frame) -> str:
    """Whether the goal is met, or how the episode ended: a word or two."""
    if not frame.ended:
        return "goal met" if frame.world.success else "goal not met"
    return "SUCCESS" if frame.world.success else "FAIL"
