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
from madviz.session.simulation import Snapshot

MOST_ROWS = 16
"""Subsets above which merged features of the past are rounded."""


class Timeline:
    """What happened in the present episode, and what had happened before it was forked."""

    def __init__(self) -> None:
        self._history: list[TimelinePoint] = []
        self._past: list[tuple[Frame, Snapshot]] = []
        self._branch: tuple[int, tuple[Frame, ...], tuple[TimelinePoint, ...]] | None = None
        self.shown: int | None = None
        """The earlier step that is shown; None: the newest one."""

    def keep(self, frame: Frame, saved: Snapshot) -> None:
        """Takes in the newest step; a step that comes again replaces itself and all after it."""
        world = replace(frame.world, probe=_thin(frame.world.probe))
        past = replace(frame, world=world, second=None, saliency=None)
        self._past[world.step :] = [(past, saved)]

    def live(self, frame: Frame) -> Frame:
        """``frame``, the newest one, with the history up to it."""
        world = frame.world
        now = TimelinePoint(
            frame.q, world.reward, world.success, frame.condition, world.policy.name
        )
        self._history[world.step :] = [now]
        return self._with_past(frame)

    def show(self, step: int | None) -> None:
        """Chooses what ``again`` shows, at most the last step there is."""
        newest = len(self._past) - 1
        self.shown = None if step is None or step >= newest else step

    def again(self, like: Frame) -> Frame:
        """The step that is shown, with the number, pace and outcomes of the live frame."""
        assert self.shown is not None
        past = self._past[self.shown][0]
        world = replace(past.world, outcomes=like.world.outcomes)
        return self._with_past(replace(past, world=world, pace=like.pace))

    def fork(self) -> Snapshot:
        """Makes the step that is shown the newest one; what came after becomes the branch."""
        assert self.shown is not None
        at, self.shown = self.shown, None
        frames = tuple(frame for frame, _ in self._past)
        self._branch = (at, frames, tuple(self._history))
        saved = self._past[at][1]
        del self._past[at + 1 :], self._history[at + 1 :]
        return saved

    def _with_past(self, frame: Frame) -> Frame:
        branch = None
        if self._branch is not None:
            at, frames, history = self._branch
            branch = Branch(at, history, frames[min(frame.world.step, len(frames) - 1)])
        return replace(frame, history=tuple(self._history), branch=branch)


def _thin(probe: Probe) -> Probe:
    readout = probe.readout
    if len(probe.masks) <= MOST_ROWS:
        return probe
    merged = readout.merged.astype(np.float16)
    return replace(probe, readout=replace(readout, merged=merged))
