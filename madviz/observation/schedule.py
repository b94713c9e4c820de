"""When cameras fail: a small language of schedules, and scenarios with a name.

A visitor's clicks never come twice at the same step, so a comparison of two policies needs failures
that do. A schedule is a few events, each the state of one camera from one step on:

    third_a@20              dropped from step 20 on
    third_a@20-40           dropped at step 20, back at step 40
    third_a=black@20        occluded: it stays in the sum, and sends black
    third_b=noise:0.5@10-30 noise of strength 0.5 for 20 decisions
    first=patch:1:0.3:0.5:0.4:0.2@5
                            a patch of strength 1; its middle from the left and the top, its width
                            and its height follow, as shares of the picture

Step 20 is the time step after 20 decisions; the 21st is the first one taken without the camera. An
event at step 0 holds for the first picture already. Where several events meet in one camera at one
step, cameras come back first, and of the others the last one counts.

A scenario says the same for cameras by their position and for steps as parts of the episode, so
that it fits every task: with a horizon of 100, a failure from 0.2 to 0.4 lasts from step 20 to 40.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from madviz.errors import UserError, unknown
from madviz.observation.ablation import PLACE, CameraState, Occlusion, OcclusionKind
from madviz.types import EnvSpec

LATEST = 100_000
"""The last step that a schedule may name; no task here has as many."""
DROPPED = "off"
"""What ``third_a@20`` means when spelled out: ``third_a=off@20``."""
HOW = "camera@step, camera@from-to or camera=black@step, for example third_b=noise:0.5@10-30"


@dataclass(frozen=True)
class Event:
    """The state of one camera from ``step`` on; by itself: it works again."""

    step: int
    camera: str
    dropped: bool = False
    occlusion: Occlusion = Occlusion()

    def __post_init__(self) -> None:
        if not 0 <= self.step <= LATEST:
            raise UserError(f"a step must be between 0 and {LATEST}, found {self.step}")

    @property
    def works(self) -> bool:
        """Whether the camera is intact from here on."""
        return not self.dropped and self.occlusion.kind == "none"

    def state(self, intact: CameraState) -> CameraState:
        """What the camera's switches are then; ``intact`` is how its policy likes it to be."""
        switch = "off" if self.dropped else intact.input
        return CameraState(switch, self.occlusion)


Schedule = tuple[Event, ...]


def in_order(events: Sequence[Event]) -> Schedule:
    """By step; at one step, cameras come back before others fail."""
    return tuple(sorted(events, key=lambda event: (event.step, not event.works)))


def events_of(camera: str, what: str, begin: int, end: int | None) -> list[Event]:
    """A failure ``what`` (``off``, ``black``, ``noise:0.5``) from step ``begin`` on, and the return
    of the camera at ``end``. Raises UserError if it ends before it begins."""
    if end is not None and end <= begin:
        raise UserError(f"expected a failure that ends after step {begin}, found {end}: swap them")
    if what == DROPPED:
        failing = Event(begin, camera, dropped=True)
    else:
        failing = Event(begin, camera, occlusion=_occlusion(what))
    return [failing] if end is None else [failing, Event(end, camera)]


def _occlusion(what: str) -> Occlusion:
    """``kind``, ``kind:strength`` or, of a patch, ``kind:strength:x:y:width:height``."""
    kind, *numbers = what.split(":")
    known = [name for name in get_args(OcclusionKind) if name != "none"]
    if kind not in known:
        raise unknown("failure", kind, [DROPPED, *known])
    most = 1 + len(PLACE) if kind == "patch" else 1
    if len(numbers) not in (0, 1, most):
        raise UserError(
            f"expected a strength after {kind!r}, and of a patch its {', '.join(PLACE)}, as in "
            f"patch:1:0.3:0.5:0.4:0.2; found {what!r:.60}"
        )
    shares = [_share(number, f"after {kind!r}") for number in numbers]
    return Occlusion(kind, *shares)  # type: ignore[arg-type]


def _share(word: str, where: str) -> float:
    """A number in [0, 1]. Raises UserError for anything else."""
    if not re.fullmatch(r"[01](\.\d{1,6})?|\.\d{1,6}", word) or float(word) > 1:
        raise UserError(f"expected a number from 0 to 1 {where}, found {word!r:.20}")
    return float(word)


def parse_schedule(words: Sequence[str], cameras: Sequence[str]) -> Schedule:
    """The schedule of ``words``; see the module. Raises UserError for an unknown camera or failure,
    and for what is none of the forms."""
    events: list[Event] = []
    for word in words:
        found = re.fullmatch(r"(\w+)(?:=([a-z]+[\d.:]*))?@(\d{1,6})(?:-(\d{1,6}))?", word)
        if found is None:
            raise UserError(f"expected a failure such as {HOW}; found {word!r:.60}")
        camera, what, begin, end = found.groups()
        if camera not in cameras:
            raise unknown("camera", camera, list(cameras))
        events += events_of(camera, what or DROPPED, int(begin), int(end) if end else None)
    return in_order(events)


def in_words(schedule: Schedule) -> list[str]:
    """The schedule in its own language again, one word for every event; a camera that comes back
    closes the word before it."""
    words: list[str] = []
    open_: dict[str, int] = {}
    for event in schedule:
        if not event.works:
            what = "" if event.dropped else f"={_spelled(event.occlusion)}"
            open_[event.camera] = len(words)
            words.append(f"{event.camera}{what}@{event.step}")
        elif event.camera in open_:
            words[open_.pop(event.camera)] += f"-{event.step}"
    return words


def _spelled(occlusion: Occlusion) -> str:
    """As briefly as it can be said."""
    numbers = "" if occlusion.strength == 1 else f":{occlusion.strength:g}"
    place = [round(getattr(occlusion, name), 3) for name in PLACE]
    if occlusion.kind == "patch" and place != [getattr(Occlusion(), name) for name in PLACE]:
        numbers = f":{occlusion.strength:g}:" + ":".join(f"{value:g}" for value in place)
    return occlusion.kind + numbers


@dataclass(frozen=True)
class FailureSpan:
    """One failure of a scenario."""

    camera: int
    """Its place among the environment's cameras, from 0; the failure is left out where there is no
    such camera."""
    what: str
    """``off``, or an occlusion with its strength: ``noise:0.5``."""
    begin: float
    """Part of the episode, in [0, 1]."""
    end: float | None = None
    """Part of the episode at which the camera works again; None: never."""


@dataclass(frozen=True)
class Scenario:
    """Failures with a name that belong together."""

    name: str
    words: str
    """One line for somebody who sees the page for the first time."""
    spells: tuple[FailureSpan, ...]

    def schedule(self, env: EnvSpec) -> Schedule:
        """The events for the cameras and the horizon of ``env``."""
        events: list[Event] = []
        for spell in self.spells:
            if spell.camera < len(env.cameras):
                begin = round(spell.begin * env.horizon)
                end = None if spell.end is None else max(round(spell.end * env.horizon), begin + 1)
                events += events_of(env.cameras[spell.camera].name, spell.what, begin, end)
        return in_order(events)


_PLACES = range(8)
SCENARIOS = (
    Scenario(
        "blackout one by one",
        "One camera after another is lost; the first one stays to the end.",
        tuple(FailureSpan(place, "off", 0.05 + 0.15 * place) for place in _PLACES[1:]),
    ),
    Scenario(
        "taking turns",
        "Every camera is lost for a while, never two at once.",
        tuple(FailureSpan(p, "off", 0.1 + 0.2 * p, 0.3 + 0.2 * p) for p in _PLACES[:4]),
    ),
    Scenario(
        "flickering",
        "The second camera drops out and comes back, again and again.",
        tuple(FailureSpan(1, "off", 0.1 + 0.08 * n, 0.14 + 0.08 * n) for n in range(10)),
    ),
    Scenario(
        "lens covered",
        "Something hangs before the first camera: it sends black, and the policy believes it.",
        (FailureSpan(0, "black", 0.2, 0.7),),
    ),
    Scenario(
        "bad cable",
        "The second camera's picture gets noisier, then the camera drops out.",
        (
            FailureSpan(1, "noise:0.3", 0.1),
            FailureSpan(1, "noise:0.7", 0.3),
            FailureSpan(1, "off", 0.5),
        ),
    ),
    Scenario(
        "weak radio link",
        "Every camera loses most of its pictures; the last one that came stays.",
        tuple(FailureSpan(place, "dropout:0.8", 0.1) for place in _PLACES),
    ),
    Scenario(
        "slow network",
        "Every camera's picture comes half a second late at normal speed.",
        tuple(FailureSpan(place, "delay:0.5", 0.1) for place in _PLACES),
    ),
    Scenario(
        "stuck picture",
        "The third camera freezes, and nobody notices.",
        (FailureSpan(2, "freeze", 0.15),),
    ),
    Scenario(
        "fog",
        "All cameras are blurred for the middle of the episode.",
        tuple(FailureSpan(place, "blur:0.4", 0.25, 0.75) for place in _PLACES),
    ),
)


def scenario(name: str) -> Scenario:
    """The scenario called ``name``. Raises UserError listing the known ones."""
    for one in SCENARIOS:
        if one.name == name:
            return one
    raise unknown("scenario", name, [one.name for one in SCENARIOS])


def reached(schedule: Schedule, step: int, cameras: Sequence[str]) -> Schedule:
    """What a session has to do when ``step`` arrives: the events of that step whose camera exists.
    At step 0, cameras that fail later begin intact, however the last episode left them."""
    events = [event for event in schedule if event.step == step]
    if step == 0:
        named = dict.fromkeys(event.camera for event in schedule)
        early = {event.camera for event in events}
        events = [Event(0, camera) for camera in named if camera not in early] + events
    return tuple(event for event in events if event.camera in cameras)
