"""Success so far: what shipped with a policy, and what was measured here while the page was open.

Episodes are kept by seed, so that the same one seen twice (by a worker and on a page, or on two
pages) counts once. Listeners are told when something was added; the tables themselves are replaced,
never changed, so readers need no lock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from madviz.frame import Setting
from madviz.statistics import wilson
from madviz.types import PolicySpec

Shipped = Callable[[PolicySpec], Mapping[str, Mapping[str, Any]]]
"""Policy -> the ``subsets`` of its evaluation.json, empty where it has none."""


@dataclass(frozen=True)
class Rate:
    """Successes among episodes."""

    successes: int = 0
    n: int = 0

    @property
    def mean(self) -> float:
        return self.successes / self.n if self.n else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """95% Wilson."""
        return wilson(self.successes, self.n)


class Rates:
    """Shared by all visitors: success is a fact about a policy and a setting, not a person."""

    def __init__(self, shipped: Shipped = lambda spec: {}) -> None:
        self._read = shipped
        self._shipped: dict[str, dict[str, Rate]] = {}
        self._live: dict[tuple[str, Setting], dict[int, bool]] = {}
        self._listeners: tuple[Callable[[], None], ...] = ()

    def shipped(self, spec: PolicySpec) -> dict[str, Rate]:
        """By subset, without occlusions: what the policy's own evaluation says."""
        key = spec.name + spec.digest
        if key not in self._shipped:
            table = {
                subset: Rate(round(row["success"] * row["n"]), row["n"])
                for subset, row in self._read(spec).items()
            }
            self._shipped = {**self._shipped, key: table}
        return self._shipped[key]

    def live(self, spec: PolicySpec, setting: Setting) -> Rate:
        """What was measured here."""
        seen = self._live.get((spec.name + spec.digest, setting), {})
        return Rate(sum(seen.values()), len(seen))

    def best(self, spec: PolicySpec, setting: Setting) -> Rate:
        """Whichever says more. They are not added up: workers begin with the shipped seeds."""
        known = Rate() if setting.occlusions else self.shipped(spec).get(setting.subset, Rate())
        live = self.live(spec, setting)
        return live if live.n >= known.n else known

    def add(self, spec: PolicySpec, setting: Setting, outcomes: Mapping[int, bool]) -> None:
        """Takes outcomes by seed; tells the listeners if one of them is new."""
        key = (spec.name + spec.digest, setting)
        before = self._live.get(key, {})
        if outcomes.items() <= before.items():
            return
        self._live = {**self._live, key: {**before, **outcomes}}
        for listener in self._listeners:
            listener()

    def subscribe(self, listener: Callable[[], None]) -> None:
        self._listeners = (*self._listeners, listener)

    def unsubscribe(self, listener: Callable[[], None]) -> None:
        self._listeners = tuple(one for one in self._listeners if one != listener)
