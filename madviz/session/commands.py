"""The commands of a session, all frozen, checked where they are made.

A page sends them from any thread; the simulation's own thread serves them, between two camera
renders if it must be quick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from madviz.errors import UserError
from madviz.observation.ablation import Ablation, CameraState
from madviz.observation.displacement import MoveCamera
from madviz.observation.schedule import Schedule


class SessionCommand:
    """Base of all of them but ``MoveCamera``, which belongs to the observation."""


@dataclass(frozen=True)
class SetCamera(SessionCommand):
    """Another switch or occlusion for one camera."""

    camera: str
    state: CameraState


@dataclass(frozen=True)
class SetPolicy(SessionCommand):
    """Another policy, by a name ``load_policy`` knows; camera settings stay."""

    name: str


@dataclass(frozen=True)
class SetSeed(SessionCommand):
    """Start the episode of this seed."""

    seed: int

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**31:
            raise UserError(f"a seed must be between 0 and {2**31 - 1}, found {self.seed}")


@dataclass(frozen=True)
class Play(SessionCommand):
    """Goes on with the episode at the chosen speed."""


@dataclass(frozen=True)
class Pause(SessionCommand):
    """Stays at this time step; cameras can still be switched."""


@dataclass(frozen=True)
class StepOnce(SessionCommand):
    """One decision, then pause."""


@dataclass(frozen=True)
class Reset(SessionCommand):
    """Start again: the same seed, or the next one."""

    next_seed: bool = False


@dataclass(frozen=True)
class SetSpeed(SessionCommand):
    """Decisions per second; None for as fast as it goes."""

    rate: float | None

    def __post_init__(self) -> None:
        if self.rate is not None and not 0.01 <= self.rate <= 1000:
            raise UserError(f"speed must be 0.01 to 1000 decisions per second, found {self.rate}")


@dataclass(frozen=True)
class SetAutoNext(SessionCommand):
    """Whether the next seed starts by itself when an episode is over."""

    on: bool


@dataclass(frozen=True)
class Scrub(SessionCommand):
    """Show an earlier step of this episode; None goes back to the newest one."""

    step: int | None

    def __post_init__(self) -> None:
        if self.step is not None and not 0 <= self.step < 2**31:
            raise UserError(f"a step must be 0 or more, found {self.step}")


@dataclass(frozen=True)
class Compare(SessionCommand):
    """Start B beside this simulation, on the same seeds: another policy or the same one, under
    ``ablation``; linked to A if that is A's now, too. None ends it."""

    policy: str | None
    ablation: Ablation = Ablation()


@dataclass(frozen=True)
class Link(SessionCommand):
    """Whether what is done to A's cameras is done to B's, too. Once it is, they are as A's."""

    on: bool


@dataclass(frozen=True)
class Fork(SessionCommand):
    """Go on from the earlier step that is shown, without what came after."""


@dataclass(frozen=True)
class ReadSubsets(SessionCommand):
    """Whether every subset is read where each costs a pass, as far as there is time for it."""

    on: bool


@dataclass(frozen=True)
class Foresee(SessionCommand):
    """Imagine the decisions after the newest step, under the present cameras; what then happens is
    held against it. Without ``on``, what was imagined is forgotten."""

    on: bool = True


@dataclass(frozen=True)
class SetSaliency(SessionCommand):
    """Which pixels to find, those that Q or those that the action hangs on; None for none."""

    target: Literal["q", "action"] | None


@dataclass(frozen=True)
class SetSchedule(SessionCommand):
    """Failures that come by themselves, in this episode from here on and in all that follow, until
    there is another schedule; an empty one ends them, and its cameras work again. Events whose step
    has passed wait for the next episode. A reset starts the same failures again."""

    events: Schedule = ()


Command = SessionCommand | MoveCamera


IN_ANY_ORDER = (
    SetCamera,
    MoveCamera,
    Pause,
    SetSpeed,
    SetAutoNext,
    SetSaliency,
    ReadSubsets,
)
"""Commands before which a later one on a camera may be carried out."""
