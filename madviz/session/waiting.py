"""While a policy decides, its visitor is answered all the same.

The problem: one thread owns the simulation and its policy, and carries out what a visitor asks for.
A policy that takes 3 s for a decision keeps that thread for so long: a switch that is pressed shows
nothing, and nobody says why.

The idea: that thread notes when it asks the policy (``PolicyWait``). It then touches nothing else,
so another thread may take its commands, and show the last frame as they will make it
(``promised``). They are carried out when the policy has answered, before its next decision.

    simulates   step ── asks the policy ···················· has its answer ── carries out ── step
    attends                 wakes ── takes commands ── shows what they will do
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

from madviz.errors import UserError
from madviz.observation.ablation import Ablation
from madviz.observation.displacement import MoveCamera
from madviz.session.commands import (
    Command,
    Link,
    Pause,
    Play,
    ReadSubsets,
    SetAutoNext,
    SetCamera,
    SetSpeed,
)
from madviz.session.frame import Frame, World

ATTENDED_AFTER = 0.15
"""Seconds that a policy may take before somebody else attends to the visitor."""
LOOKS_EVERY = 0.05
"""Seconds between two looks at what has come."""


class PolicyWait:
    """Since when the policy has been asked; ``with`` it, the simulating thread asks."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since: float | None = None
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        with self._lock:
            self._since = self._clock()

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._since = None

    @contextmanager
    def lasting(self) -> Iterator[float]:
        """Seconds for which the policy has been asked, 0.0 if it is not. The simulating thread does
        not go on before the end of the block, so that what it owns may be touched meanwhile."""
        with self._lock:
            yield 0.0 if self._since is None else self._clock() - self._since


def promised(frame: Frame, commands: Iterable[Command]) -> Frame:
    """``frame`` with the switches as ``commands`` will set them. Pictures and readings stay; one
    that nothing can be said of beforehand, such as another seed, changes nothing."""
    for command in commands:
        frame = _after(frame, command)
    return frame


def _after(frame: Frame, command: Command) -> Frame:
    pace = frame.pace
    match command:
        case SetCamera() | MoveCamera():
            second = frame.second
            if second is not None and frame.linked:
                second = replace(second, world=_touched(second.world, command))
            return replace(frame, world=_touched(frame.world, command), second=second)
        case Pause():
            pace = replace(pace, phase="paused")
        case Play():
            pace = replace(pace, phase="playing")
        case SetSpeed(rate):
            pace = replace(pace, speed=rate)
        case SetAutoNext(on):
            pace = replace(pace, auto_next=on)
        case ReadSubsets(on):
            pace = replace(pace, reads_all=on)
        case Link(on):
            return replace(frame, linked=on)
    return replace(frame, pace=pace)


def _touched(world: World, command: SetCamera | MoveCamera) -> World:
    """``world`` with one camera as the command sets it, if there is such a camera."""
    ablation: Ablation = world.ablation
    with suppress(UserError):
        world.env.camera(command.camera)
        if isinstance(command, SetCamera):
            ablation = ablation.replace(command.camera, command.state)
        else:
            ablation = ablation.move(command.camera, command.move)
    return replace(world, ablation=ablation)
