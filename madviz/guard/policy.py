"""Wraps a policy: a camera that fails is left out, and used again when it works.

    policy = GuardedPolicy(madviz.load_policy(name), read_values(file, "madviz guard --policy P"))
    player = policy.reset(seed)
    action = player.act(policy.encode(views, state), mask)      one call for each step
    player.report.verdicts                                      what was found, by stream

Where the policy cannot act without the camera, the last good picture stands in, or the episode
stops; ``instead`` chooses. ``player.report.note`` says what happens to the cameras that fail.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np

from madviz.errors import UserError
from madviz.guard.detector import CameraVerdict, Guard
from madviz.guard.values import GuardValues
from madviz.subsets import camera_of
from madviz.types import (
    Array,
    Encoded,
    Foresees,
    Future,
    Imagines,
    Player,
    Policy,
    PolicyWithMemory,
    Readout,
)

SUFFIX = " (guarded)"
"""The name of a policy ends so where it has a guard."""
Instead = Literal["last", "stop"]
"""For a camera that fails and cannot be left out: its last good picture, or an error."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """The part of ``Encoded`` that the guard reads."""

    views: Array
    """(V, C, H, W)."""
    state: Array
    """(S,) as it was given; ``Encoded.state`` may be the policy's own form of it."""
    private: Any
    """The private part of the guarded policy."""


@dataclass(frozen=True, eq=False)
class GuardReport:
    """The guard's report on one decision."""

    verdicts: dict[str, CameraVerdict]
    """By stream that is present."""
    mask: Array
    """(V,) bool: the streams that the decision rests on."""
    step: int = 0
    """The step of the guard, which counts from where it began to watch."""
    note: str = ""
    """A sentence on the cameras that fail; '' where none does."""

    @property
    def failed(self) -> frozenset[str]:
        """The cameras that fail. A camera fails with all its streams."""
        return frozenset(camera_of(name) for name, one in self.verdicts.items() if not one.fine)

    def verdict(self, camera: str) -> CameraVerdict:
        """The verdict on a camera: the first of its streams' that is not fine."""
        ours = [one for name, one in self.verdicts.items() if camera_of(name) == camera]
        return next((one for one in ours if not one.fine), CameraVerdict())


class GuardedPolicy:
    """A policy with a guard; see the module. Each episode has a guard of its own."""

    def __init__(self, policy: Policy, values: GuardValues, instead: Instead = "last") -> None:
        """Raises UserError where ``values`` lack a stream of ``policy``."""
        if missing := [name for name in policy.spec.streams if name not in values.streams]:
            raise UserError(
                f"expected values of the guard for {', '.join(policy.spec.streams)}, found none "
                f"for {missing[0]}; run `madviz guard --policy {policy.spec.name}`"
            )
        self.inner = policy
        self.values = values
        self.instead: Instead = instead
        words = f"guard {policy.spec.digest} {values.digest} {instead}"
        digest = hashlib.sha256(words.encode()).hexdigest() if policy.spec.digest else ""
        self.spec = replace(policy.spec, name=policy.spec.name + SUFFIX, digest=digest)

    def encode(self, views: Array, state: Array) -> Encoded:
        """The guard keeps pictures and state; else it is what the policy does."""
        encoded = self.inner.encode(views, state)
        return replace(encoded, private=_Seen(views, state, encoded.private))

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        """As the policy does, on the subsets that are asked for: the guard changes nothing here."""
        return self.inner.read(_without(encoded), masks)

    def supports(self, mask: Array) -> bool:
        return self.inner.supports(mask)

    @property
    def agent(self) -> object:
        """The policy's networks, for its saliency; None where it has none of torch."""
        return getattr(self.inner, "agent", None)

    @staticmethod
    def pictures(encoded: Encoded) -> Array:
        """(V, C, H, W) uint8: the pictures that were encoded."""
        return encoded.private.views

    @property
    def foresees(self) -> bool:
        return isinstance(self.inner, Foresees) and self.inner.foresees

    def foresee(self, encoded: Encoded, mask: Array, decisions: int) -> Future:
        """The policy imagines as it does without a guard: no camera fails there."""
        assert isinstance(self.inner, Foresees)
        return self.inner.foresee(_without(encoded), mask, decisions)

    @property
    def imagines(self) -> bool:
        return isinstance(self.inner, Imagines) and self.inner.imagines

    def imagine(self, encoded: Encoded, mask: Array) -> Array:
        """The pictures that the policy imagines, as ``Imagines`` says."""
        assert isinstance(self.inner, Imagines)
        return self.inner.imagine(_without(encoded), mask)

    def mean_pictures(self) -> Array:
        """The policy's own, as ``Imagines`` says."""
        assert isinstance(self.inner, Imagines)
        return self.inner.mean_pictures()

    def reset(self, seed: int) -> GuardedPlayer:
        """An episode begins."""
        player = self.inner.reset(seed) if isinstance(self.inner, PolicyWithMemory) else None
        return GuardedPlayer(self, player)


class GuardedPlayer:
    """Acts in one episode on the cameras that work."""

    def __init__(self, policy: GuardedPolicy, player: Player | None) -> None:
        self._policy = policy
        self._player = player
        self._guard = Guard(policy.values)
        self._last_good: dict[str, Array] = {}
        """(C, H, W) by stream, as it came when its camera last worked."""
        self.report = GuardReport({}, np.zeros(len(policy.spec.streams), bool))
        """On the newest decision."""
        self.noticed: int | None = None
        """The first decision at which a camera failed."""

    @property
    def planned(self) -> int:
        """Decisions that are settled already."""
        return self._player.planned if self._player else 0

    @property
    def outside(self) -> int:
        """Action numbers that the policy itself clipped to [-1, 1]."""
        return getattr(self._player, "outside", 0)

    def act(self, encoded: Encoded, mask: Array) -> Array:
        """(A,): the next decision, on those streams of ``mask`` (V,) whose cameras work. Raises
        UserError where one cannot be left out and ``instead`` is ``stop``."""
        self.report, used = self._look(self._guard, encoded, mask)
        if self.noticed is None and self.report.failed:
            self.noticed = self.report.step
        streams = self._policy.spec.streams
        bad = {camera_of(stream) for stream in self.report.verdicts if not self._guard.good(stream)}
        for index, stream in enumerate(streams):
            if mask[index] and camera_of(stream) not in bad:
                self._last_good[stream] = encoded.private.views[index].copy()
        if self._player is not None:
            return self._player.act(_without(used), self.report.mask)
        return self._policy.read(used, self.report.mask[None]).action[0]

    def look(self, encoded: Encoded, mask: Array) -> tuple[GuardReport, Encoded]:
        """The report that ``act`` would give now, and the features that it would act on. Nothing is
        remembered."""
        return self._look(copy(self._guard), encoded, mask)

    def close(self) -> None:
        """The episode is over, or was left."""
        if self._player is not None:
            self._player.close()

    def _look(self, guard: Guard, encoded: Encoded, mask: Array) -> tuple[GuardReport, Encoded]:
        """``guard`` takes one step."""
        streams = self._policy.spec.streams
        pictures = {
            stream: encoded.private.views[index, -3:].transpose(1, 2, 0)  # (H, W, 3)
            for index, stream in enumerate(streams)
            if mask[index]
        }
        report = GuardReport(guard.step(pictures, encoded.private.state), mask, guard.now - 1)
        failed = report.failed
        if not failed:
            return report, encoded
        needed = self._needed(mask, failed)
        used = mask & _outside(streams, failed - needed)  # (V,)
        out = f"{_list(failed - needed)} left out" if failed - needed else ""
        if needed:
            encoded, stands_in = self._stood_in(encoded, needed)
            note = f"{out}; {stands_in}" if out else stands_in
        else:
            rest = "" if used.any() else "; no camera is left: the policy acts on the state"
            note = f"{out}{rest}"
        return replace(report, mask=used, note=note), encoded

    def _needed(self, mask: Array, failed: frozenset[str]) -> frozenset[str]:
        """The fewest cameras among ``failed`` without which the policy cannot act, those with a
        good picture first; none where it can do without all of them."""
        streams = self._policy.spec.streams
        blind = {camera_of(name) for name in streams if name not in self._last_good}
        choices = [
            frozenset(choice)
            for count in range(len(failed))
            for choice in combinations(sorted(failed), count)
        ]
        able = [
            choice
            for choice in choices
            if self._policy.supports(mask & _outside(streams, failed - choice))
        ]
        return min(able, key=lambda choice: (len(choice & blind), len(choice)), default=failed)

    def _stood_in(self, encoded: Encoded, needed: frozenset[str]) -> tuple[Encoded, str]:
        """The features with the last good pictures of the cameras that are ``needed``, and the
        words for it."""
        name = self._policy.inner.spec.name
        if self._policy.instead == "stop":
            raise UserError(
                f"expected cameras that {name} can act on, found {_list(needed)} failing, without "
                "which it cannot act; repair the camera, or choose the last good picture"
            )
        views = encoded.private.views.copy()  # (V, C, H, W)
        missing = set()
        for index, stream in enumerate(self._policy.spec.streams):
            if camera_of(stream) in needed:
                missing |= set() if stream in self._last_good else {camera_of(stream)}
                views[index] = self._last_good.get(stream, views[index])
        note = f"{name} cannot leave out {_list(needed)}: the last good picture stands in"
        if missing:
            note += f"; {_list(missing)} has none and is used as it comes"
        return self._policy.encode(views, encoded.private.state), note


def guard_note(policy: Policy) -> str:
    """One sentence on what a guard does for ``policy`` when one camera fails; '' without one."""
    if not isinstance(policy, GuardedPolicy):
        return ""
    streams = policy.spec.streams
    stuck = []
    for camera in dict.fromkeys(map(camera_of, streams)):
        rest = np.array([camera_of(stream) != camera for stream in streams])
        with suppress(UserError):
            if policy.supports(rest):
                continue
        stuck.append(camera)
    words = "With the guard: a camera that fails is left out until it works again"
    if not stuck:
        return f"{words}."
    last = "its last good picture stands in" if policy.instead == "last" else "the episode stops"
    return f"{words}; where that is not possible ({', '.join(stuck)}), {last}."


def _outside(streams: tuple[str, ...], cameras: frozenset[str]) -> Array:
    """(V,) bool: the streams of all other cameras."""
    return np.array([camera_of(stream) not in cameras for stream in streams])


def _without(encoded: Encoded) -> Encoded:
    """``encoded`` as the guarded policy made it."""
    return replace(encoded, private=encoded.private.private)


def _list(cameras: frozenset[str] | set[str]) -> str:
    return ", ".join(sorted(cameras))
