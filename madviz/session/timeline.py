"""An episode's past: every step as it was shown, and another future from any of them.

The problem: which camera mattered is often decided long before an episode fails, and a live page
has moved on by then. The idea: frames are frozen, so an episode's past is a list of them;
and an episode is its seed and its actions, so going back is taking these once more, without
drawing (``Simulation.return_to``). Hammer's step 60 is there again in 0.2 s.

    0 ──── 20 ──── 40 ──── 60 ──── 80 ── 100    the first future, now a ``Branch``
                    └───── 60 ─ ·               forked at 40: the live one now

Memory: a step of three 84-pixel RGB cameras takes 0.35 MB, an episode and its branch some 70 MB. A
policy with many streams has its past merged features rounded to half precision, for the page alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from madviz.analysis.probes import Probe
from madviz.session.frame import Branch, Frame, TimelinePoint
from madviz.session.open_loop import from_recorded
from madviz.session.simulation import Snapshot

MOST_ROWS = 16
"""Subsets above which merged features of the past are rounded."""


class Timeline:
    """The steps of the present episode, and those before it was forked."""

    def __init__(self) -> None:
        self._history: list[TimelinePoint] = []
        self._past: list[tuple[Frame, Snapshot]] = []
        self._branch: tuple[int, tuple[Frame, ...], tuple[TimelinePoint, ...]] | None = None
        self.shown: int | None = None
        """The earlier step that is shown; None: the newest one."""

    def live(self, frame: Frame, saved: Snapshot, keep: bool) -> Frame:
        """``frame``, the newest one, with the history up to it. ``keep``: it replaces its step and
        all after it. A step that is not there yet is taken in either way."""
        world = frame.world
        reward = world.reward if world.recorded is None else from_recorded(frame)
        now = TimelinePoint(
            frame.q, reward, world.success, frame.condition, world.policy.name, world.last
        )
        history = [*self._history[: world.step], now]
        if keep or world.step >= len(self._history):
            thin = replace(world, probe=_thin(world.probe))
            past = replace(frame, world=thin, second=None, saliency=None)
            self._past[world.step :] = [(past, saved)]
            self._history = history
        return self._with_past(frame, history)

    def show(self, step: int | None) -> None:
        """Chooses what ``again`` shows, at most the last step there is."""
        newest = len(self._past) - 1
        self.shown = None if step is None or step >= newest else step

    def again(self, like: Frame) -> Frame:
        """The step that is shown. Outcomes, and all that is no part of a step, are those of the
        live frame ``like``; B and the saliency of that step are not kept."""
        assert self.shown is not None
        world = replace(self._past[self.shown][0].world, outcomes=like.world.outcomes)
        return self._with_past(
            replace(like, world=world, second=None, saliency=None), self._history
        )

    def fork(self) -> Snapshot:
        """Makes the step that is shown the newest one; what came after becomes the branch."""
        assert self.shown is not None
        at = self.shown
        self.shown = None
        frames = tuple(frame for frame, _ in self._past)
        self._branch = (at, frames, tuple(self._history))
        saved = self._past[at][1]
        del self._past[at + 1 :], self._history[at + 1 :]
        return saved

    def _with_past(self, frame: Frame, history: list[TimelinePoint]) -> Frame:
        branch = None
        if self._branch is not None:
            at, frames, first = self._branch
            branch = Branch(at, first, frames[min(frame.world.step, len(frames) - 1)])
        return replace(frame, history=tuple(history), branch=branch)


def _thin(probe: Probe) -> Probe:
    readout = probe.readout
    if len(probe.masks) <= MOST_ROWS:
        return probe
    merged = readout.merged.astype(np.float16)
    return replace(probe, readout=replace(readout, merged=merged))
