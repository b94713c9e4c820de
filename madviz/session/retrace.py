"""The end of an episode once more with all cameras, from their first change on: the hand's path.

An episode is its seed and its decisions, so the environment that played it can play another end of
it, while a page shows the end and needs no environment. Then it takes the episode's own actions
once more, without drawing, and stands where it stood.

    episode    0 ──── 15, a camera goes ──── 100      its actions, without pictures ──┐
    replay            15 ─────────────────── 100      all cameras, decision by decision
                      └ decided the same twice, or there is nothing to say            ▼
                                                      ``HandPaths`` from 15 on
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from madviz.errors import UserError
from madviz.observation.ablation import Ablation
from madviz.observation.condition import Condition
from madviz.observation.displacement import MoveCamera
from madviz.session.commands import SetCamera
from madviz.session.frame import HandPaths, untouched
from madviz.session.simulation import Simulation
from madviz.session.snapshot import Snapshot
from madviz.types import Array
from madviz.wire.policy import ServedPolicy

TRIAL = 2
"""Decisions that are taken twice: the first may come from what the episode has read already."""


class Retrace:
    """The replay of one side's ended episode. Belongs to the thread that has ``live``."""

    def __init__(self, live: Simulation, before: Snapshot | None) -> None:
        """``before``: the step of the first change; None where there was none. Nothing is done yet.
        Without a change, in a recording, or where the policy was exchanged or is served by another
        program, it is ``done`` at once."""
        self._live = live
        served = isinstance(getattr(live.policy, "inner", live.policy), ServedPolicy)
        one_policy = {policy for policy, _ in live.record.conditions} == {live.policy.spec}
        recorded = live.env.spec.recorded
        self.done = before is None or recorded or served or not one_policy
        self.paths: HandPaths | None = None
        """Once ``done``; None where the replay was not exact or was left."""
        self._away = False
        """True while the environment is not at the end of the episode."""
        self._twin = Simulation(live.env, live.policy, Ablation())
        self._twin.seed = live.seed
        self._decisions = iter(()) if before is None else self._replay(before)

    def advance(self) -> None:
        """One decision of the replay; after the last one it is ``done``."""
        try:
            if next(self._decisions, None) is None:
                self.leave()
        except UserError:  # The simulator or the policy does not repeat the episode.
            self.leave()
        except BaseException:
            self.leave()
            raise

    def leave(self) -> None:
        """Brings the environment back to the end of the episode, as its owner left it; what was not
        ``done`` yet never will be."""
        if self._away:
            self._stand_again()
        self._twin.leave()
        self.done = True

    def _replay(self, before: Snapshot) -> Iterator[int]:
        """Yields after every decision."""
        twin = self._twin
        since = len(before.actions)
        yield from self._until(before, since + TRIAL, [])
        first = twin.snapshot().actions[since:]
        hands: list[Array] = []
        yield from self._until(before, self._live.env.spec.horizon, hands)
        again = twin.snapshot().actions[since : since + len(first)]
        taken = self._stand_again()
        exact = np.array_equal(first, again) and np.array_equal(taken[since], hands[0])
        if exact and np.array_equal(taken[-1], self._live.now.hand):
            self.paths = HandPaths(since, taken[since:], np.array(hands, np.float32))

    def _until(self, before: Snapshot, last: int, hands: list[Array]) -> Iterator[int]:
        """From the first change with all cameras to the step ``last``; puts the hand's path into
        ``hands``."""
        twin = self._twin
        self._away = True
        for camera in self._live.ablation.moves:
            twin.env.move_camera(camera, None)
        twin.return_to(before)
        for camera in before.ablation.cameras:
            twin.set_camera(SetCamera(camera, untouched(twin.policy.spec)))
        for camera in before.ablation.moves:
            twin.move_camera(MoveCamera(camera, None))
        hands.append(twin.now.hand)
        while twin.now.step < last and not twin.ended:
            twin.step(lambda: None)
            hands.append(twin.now.hand)
            yield twin.now.step

    def _stand_again(self) -> Array:
        """Cameras to their places, and the actions of the episode once more. Returns the hand's
        path (T + 1, 3), metres."""
        env = self._live.env
        for camera, move in self._live.ablation.moves.items():
            env.move_camera(camera, move.placed(env.spec.camera(camera)))
        env.reset(self._live.seed)
        hands = [env.hand()]
        for action in self._live.snapshot().actions:
            env.step(action)
            hands.append(env.hand())
        self._away = False
        return np.array(hands, np.float32)


class Retraces:
    """The replays of an ended episode, one on each side; none before they are asked for."""

    def __init__(self) -> None:
        self._replays: list[Retrace] = []
        self._before: dict[Simulation, Snapshot] = {}
        """By side: the step at which a camera was first not as in training."""

    def note(self, side: Simulation) -> None:
        """Keeps the step at which ``side`` stands if a camera is not as in training first here."""
        if side not in self._before and side.condition != Condition("all"):
            self._before[side] = side.snapshot()

    def went_back(self, side: Simulation, step: int) -> None:
        """``side`` stands at the step ``step`` again: changes from there on are undone."""
        changed = self._before.get(side)
        if changed is not None and len(changed.actions) >= step:
            del self._before[side]

    @property
    def going(self) -> bool:
        """True while a replay is not done."""
        return not all(replay.done for replay in self._replays)

    def advance(self, sides: Sequence[Simulation]) -> bool:
        """One decision of a replay. Returns whether the paths have just come to be known."""
        if not self._replays:
            self._replays = [Retrace(side, self._before.get(side)) for side in sides]
        due = [replay for replay in self._replays if not replay.done]
        if due:
            due[0].advance()
        return bool(due) and not self.going

    def leave(self) -> None:
        """Brings the environments back from a replay that was not done; the paths stay."""
        for replay in self._replays:
            replay.leave()

    def forget(self) -> None:
        """Brings the environments back, and forgets the paths."""
        self.leave()
        self._replays = []

    def begin(self) -> None:
        """Another episode: no camera was changed yet."""
        self._before = {}

    @property
    def paths(self) -> list[HandPaths | None]:
        """A's and B's; None where there is none."""
        return [replay.paths for replay in self._replays] or [None, None]
