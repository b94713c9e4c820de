"""A journal of the present episode and the last ones, with all that a replay of them needs.

A simulation writes every command and every decision into its journal; a page asks it, from another
thread, for a saved session. Two rules make its steps exact:

    A camera touched while step t+1 is being drawn counts at t+1: the decision that led there was
    taken already. One touched between two decisions counts at the step that is shown.
    At one step only a camera's last state matters, because the newest picture arrives anew with
    every command; so a slider that is dragged leaves one line. Not across a change of policy: one
    that sees other pictures gets the last ones under the states of that moment.

An episode that broke off with an exception may stand between two steps. It is never saved.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import cast

import numpy as np

from madviz.errors import UserError
from madviz.observation.ablation import Ablation
from madviz.observation.displacement import MoveCamera
from madviz.session.commands import SetCamera
from madviz.session.session_file import (
    STREAMS,
    RenderProfile,
    SavedCommand,
    SavedEpisode,
    SavedPolicy,
    SavedSession,
    hashes,
    trace_of,
    versions_here,
)
from madviz.types import Array, EnvSpec, PolicySpec, TimeStep

EPISODES = 20
"""Episodes that can be saved at most, the present one among them."""
MOST_COMMANDS = 5000
"""In one episode; somebody who swaps policies more often than that has no episode to save."""


@dataclass(frozen=True)
class Mark:
    """A step of the present episode, to come back to."""

    steps: int
    commands: tuple[SavedCommand, ...]


@dataclass
class _Present:
    policy: SavedPolicy
    env: EnvSpec
    seed: int
    start: tuple[SetCamera | MoveCamera, ...]
    commands: list[SavedCommand] = field(default_factory=list)
    streams: dict[str, list[bytes]] = field(default_factory=lambda: {s: [] for s in STREAMS})
    broken: bool = False

    @property
    def steps(self) -> int:
        return len(self.streams["actions"])

    def saved(self) -> SavedEpisode | None:
        """None where there is nothing that could be replayed."""
        if self.broken or not self.steps:
            return None
        success = b"".join(self.streams["success"])
        return SavedEpisode(
            policy=self.policy,
            task=self.env.task,
            render_profile=cast(RenderProfile, self.env.render_profile),
            cameras=self.env.cameras,
            seed=self.seed,
            start=self.start,
            # A camera may be touched while its step is still to come.
            commands=tuple(one for one in self.commands if one.step <= self.steps),
            steps=self.steps,
            ended=self.steps >= self.env.horizon,
            success=bool(success[-1]),
            success_any=any(success),
            sha256=hashes(self.streams),
            trace=trace_of(self.streams),
        )


class Journal:
    """See the module. A simulation writes; ``saved`` is for every thread."""

    def __init__(self) -> None:
        self._past: deque[SavedEpisode] = deque(maxlen=EPISODES)
        self._present: _Present | None = None
        self._lock = threading.Lock()

    def saved(self, present_only: bool = False) -> SavedSession:
        """The present episode so far, after the last ones unless ``present_only``. Raises UserError
        if there is no step."""
        with self._lock:
            now = self._present.saved() if self._present else None
            past = () if present_only else self._past
            episodes = (*past, *((now,) if now else ()))[-EPISODES:]
        if not episodes:
            which = "the episode that is running" if present_only else "an episode"
            raise UserError(
                f"expected {which} to have a step to save, found none; let it run first"
            )
        return SavedSession(episodes, versions_here())

    def begin(self, policy: PolicySpec, env: EnvSpec, seed: int, ablation: Ablation) -> None:
        start = (
            *(SetCamera(name, state) for name, state in ablation.cameras.items()),
            *(MoveCamera(name, move) for name, move in ablation.moves.items()),
        )
        with self._lock:
            self._file()
            self._present = _Present(SavedPolicy.of(policy), env, seed, start)

    def note(self, step: int, command: SetCamera | MoveCamera | SavedPolicy) -> None:
        """Another policy took over at ``step``; or a camera was set or moved when it had arrived,
        or while it was drawn."""
        with self._lock:
            present = self._present
            if present is None:
                return
            present.broken |= len(present.commands) >= MOST_COMMANDS
            if present.broken:
                return
            for index in reversed(range(len(present.commands))):
                old = present.commands[index]
                if isinstance(command, SavedPolicy) or isinstance(old.command, SavedPolicy):
                    break
                if old.step != step:
                    break
                if type(old.command) is type(command) and old.command.camera == command.camera:
                    del present.commands[index]
                    break
            present.commands.append(SavedCommand(step, command))

    def decided(self, step: int, action: Array, time_step: TimeStep) -> None:
        """The decision taken at ``step``, and what the environment made of it."""
        with self._lock:
            present = self._present
            if present is None:
                return
            # After a picture that could not be drawn, the simulator is a step ahead of the page.
            present.broken |= step != present.steps
            present.streams["actions"].append(np.asarray(action, "<f4").tobytes())
            present.streams["rewards"].append(np.asarray(time_step.reward, "<f8").tobytes())
            present.streams["success"].append(bytes([bool(time_step.success)]))

    def spoil(self) -> None:
        """Something broke in mid-episode."""
        with self._lock:
            if self._present is not None:
                self._present.broken = True

    def mark(self) -> Mark:
        """Where the present episode stands."""
        with self._lock:
            present = self._present
            return Mark(present.steps, tuple(present.commands)) if present else Mark(0, ())

    def back(self, mark: Mark) -> None:
        """The present episode stands where it stood at ``mark``; what came after becomes
        an episode of its own."""
        with self._lock:
            present = self._present
            if present is None:
                return
            if present.steps > mark.steps:
                self._file()
            for stream in present.streams.values():
                del stream[mark.steps :]
            present.commands[:] = mark.commands

    def _file(self) -> None:
        """Puts the present episode among the past ones."""
        saved = self._present.saved() if self._present else None
        if saved is not None:
            self._past.append(saved)
