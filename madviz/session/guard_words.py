"""The words for cameras that a guard has found to fail; the site says the same.

Third A is late since step 23 (the picture shows what was 5 steps ago): left out.
"""

from __future__ import annotations

from dataclasses import dataclass

from madviz.guard.detector import Kind
from madviz.session.frame import Frame

PREDICATES: dict[Kind, str] = {
    "gone": "sends nothing",
    "black": "sends black",
    "covered": "is covered",
    "noise": "sends noise",
    "blurred": "is blurred",
    "frozen": "is frozen",
    "lossy": "loses pictures",
    "late": "is late",
}


@dataclass(frozen=True)
class FailingCamera:
    """A camera that a guard has found to fail."""

    label: str
    kind: Kind
    since: int
    """The step of the episode at which it was noticed."""
    why: str
    left_out: bool
    """False where the policy cannot act without it: its last good picture stands in."""

    @property
    def badge(self) -> str:
        """``LATE · left out since step 23``."""
        what = "left out" if self.left_out else "old picture"
        return f"{self.kind.upper()} · {what} since step {self.since}"

    def __str__(self) -> str:
        what = "left out" if self.left_out else "the policy needs it; a good picture stands in"
        return f"{self.label} {PREDICATES[self.kind]} since step {self.since} ({self.why}): {what}."


def failing(frame: Frame) -> dict[str, FailingCamera]:
    """The cameras of ``frame`` that fail, by name; none without a guard."""
    world = frame.world
    report = world.guard
    if report is None:
        return {}
    found = {}
    for camera in world.env.cameras:
        verdict = report.verdict(camera.name)
        if verdict.since is not None:
            since = world.step - (report.step - verdict.since)
            found[camera.name] = FailingCamera(
                camera.label, verdict.kind, since, verdict.why, not frame.uses(camera.name)
            )
    return found


def guard_sentence(frame: Frame) -> str:
    """All that the guard says of this step; '' where no camera fails."""
    found = failing(frame)
    if not found:
        return ""
    rest = "" if frame.mask.any() else " No camera is left: the policy acts on the state alone."
    return "Guard: " + " ".join(map(str, found.values())) + rest
