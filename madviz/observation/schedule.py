"""When cameras fail: schedules of events, and scenarios with a name.

A visitor's clicks never come twice at the same step, so a comparison of two policies needs failures
that do. A schedule is a few events, each the state of one camera from one step on; ``grammar.py``
has the words for them.

Step 20 is the time step after 20 decisions; the 21st is the first one taken without the camera. An
event at step 0 holds for the first picture already. Where several events meet in one camera at one
step, cameras come back first, and of the others the last one counts.

A scenario says the same for cameras by their position and for steps as parts of the episode, so
that it fits every task: with a horizon of 100, a failure from 0.2 to 0.4 lasts from step 20 to 40.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from madviz.errors import UserError, unknown
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.grammar import CameraFailure, failure_text, parse_failure, parse_what
from madviz.system.options import Listed
from madviz.types import EnvSpec

LATEST = 100_000
"""The last step that a schedule may name; no task here has as many."""
MOST_FAILURES = 200
"""In one schedule."""


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
        """The state of the camera's switches then; ``intact`` is how its policy likes it to be."""
        switch = "off" if self.dropped else intact.input
        return CameraState(switch, self.occlusion)


Schedule = tuple[Event, ...]


def in_order(events: Sequence[Event]) -> Schedule:
    """By step; at one step, cameras come back before others fail."""
    return tuple(sorted(events, key=lambda event: (event.step, not event.works)))


def events_of(failure: CameraFailure) -> list[Event]:
    """The beginning of a failure, and the return of its camera."""
    dropped = failure.occlusion is None
    occlusion = failure.occlusion or Occlusion()
    begins = Event(failure.begin, failure.camera, dropped, occlusion)
    return [begins] if failure.end is None else [begins, Event(failure.end, failure.camera)]


def parse_schedule(words: Sequence[str], cameras: Sequence[str]) -> Schedule:
    """The schedule of ``words``, in the grammar of ``grammar.py``. Raises UserError for an unknown
    camera or failure, for what is none of the forms, and for more than ``MOST_FAILURES``."""
    if len(words) > MOST_FAILURES:
        raise UserError(
            f"expected at most {MOST_FAILURES} failures, found {len(words)}; leave some out"
        )
    failures = [parse_failure(word) for word in words]
    for failure in failures:
        if failure.camera not in cameras:
            raise unknown("camera", failure.camera, list(cameras))
    return in_order([event for failure in failures for event in events_of(failure)])


def schedule_words(schedule: Schedule) -> list[str]:
    """The schedule in its own grammar again, one word for every event; a camera that comes back
    closes the word before it."""
    words: list[str] = []
    open_: dict[str, int] = {}
    for event in schedule:
        if not event.works:
            open_[event.camera] = len(words)
            occlusion = None if event.dropped else event.occlusion
            words.append(failure_text(event.camera, occlusion, event.step))
        elif event.camera in open_:
            words[open_.pop(event.camera)] += f"-{event.step}"
    return words


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
    spans: tuple[FailureSpan, ...]

    def schedule(self, env: EnvSpec) -> Schedule:
        """The events for the cameras and the horizon of ``env``; what begins after its end is left
        out."""
        events: list[Event] = []
        for span in self.spans:
            begin = round(span.begin * env.horizon)
            if span.camera < len(env.cameras) and begin < env.horizon:
                end = None if span.end is None else max(round(span.end * env.horizon), begin + 1)
                camera = env.cameras[span.camera].name
                occlusion = parse_what(span.what)
                events += events_of(CameraFailure(camera, occlusion, begin, end))
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
        "One camera after another is lost and comes back, at most four.",
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


ScenarioName = Annotated[str, Listed("scenarios", lambda: [one.name for one in SCENARIOS])]
"""An option."""


def scenario(name: str) -> Scenario:
    """The scenario called ``name``. Raises UserError listing the known ones."""
    table = {scenario.name: scenario for scenario in SCENARIOS}
    if name not in table:
        raise unknown("scenario", name, list(table))
    return table[name]


def reached(schedule: Schedule, step: int, cameras: Sequence[str]) -> Schedule:
    """The schedule's part that is due when ``step`` arrives: the events of that step whose camera
    exists. At step 0, cameras that fail later begin intact, however the last episode left them."""
    events = [event for event in schedule if event.step == step]
    if step == 0:
        named = dict.fromkeys(event.camera for event in schedule)
        early = {event.camera for event in events}
        events = [Event(0, camera) for camera in named if camera not in early] + events
    return tuple(event for event in events if event.camera in cameras)
