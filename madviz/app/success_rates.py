"""Success so far: what shipped with a policy, and what is measured here while the page is open.

The condition of every visitor is measured; worker processes take turns among them.
Episodes are stored by seed, so that the same one seen twice (by a worker and on a page, or on two
pages) counts once. Listeners are called when something was added; tables are replaced, never
changed, so readers need no lock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any

from madviz.errors import UserError
from madviz.measure.live import Evaluator, Tally
from madviz.measure.statistics import SuccessRate
from madviz.observation.condition import Condition
from madviz.types import PolicySpec

Shipped = Callable[[PolicySpec], Mapping[str, Mapping[str, Any]]]
"""Policy -> the ``subsets`` of its evaluation.json, empty where it has none."""


NOTHING = SuccessRate.of(0, 0)
MOST_CONDITIONS = 1000
"""Conditions whose episodes are kept, those that were seen last: a slider that is dragged makes
many."""


class SuccessRates:
    """Shared by all visitors: success is a fact about a policy and a condition, not a person."""

    def __init__(
        self,
        shipped: Shipped = lambda spec: {},
        make_evaluator: Callable[[Callable[[Tally], None]], Evaluator] | None = None,
        reference: Callable[[PolicySpec], str] = lambda spec: spec.name,
    ) -> None:
        """``make_evaluator`` gets the listener for its tallies; without one nothing is measured
        but what runs on pages. ``reference`` is what ``load_policy`` knows a policy by."""
        self._read = shipped
        self._reference = reference
        self._evaluator = make_evaluator(self._hear) if make_evaluator else None
        self._errors: dict[tuple[str, Condition], str] = {}
        self._lock = threading.Lock()
        """Between writers: pages and the evaluator add episodes, and pages come and go."""
        self._shipped: dict[str, dict[str, SuccessRate]] = {}
        self._live: dict[tuple[str, Condition], dict[int, bool]] = {}
        self._outside: dict[tuple[str, Condition], float] = {}
        """The share of action numbers outside [-1, 1] in the episodes of the workers."""
        self._listeners: tuple[Callable[[], None], ...] = ()

    def shipped(self, spec: PolicySpec) -> dict[str, SuccessRate]:
        """By subset, without occlusions: what the policy's own evaluation says."""
        key = self._key(spec)
        if key not in self._shipped:
            table = {
                subset: SuccessRate.of(round(row["success"] * row["n"]), row["n"])
                for subset, row in self._read(spec).items()
            }
            self._shipped = {**self._shipped, key: table}
        return self._shipped[key]

    def live(self, spec: PolicySpec, condition: Condition) -> SuccessRate:
        """The rate that was measured here."""
        seen = self._live.get((self._key(spec), condition), {})
        return SuccessRate.of(sum(seen.values()), len(seen))

    def outcomes(self, spec: PolicySpec, condition: Condition) -> Mapping[int, bool]:
        """Success by seed of what was measured here."""
        return self._live.get((self._key(spec), condition), {})

    def outside(self, spec: PolicySpec, conditions: Iterable[Condition]) -> float:
        """The share of action numbers outside [-1, 1], on average over ``conditions``."""
        shares = [self._outside.get((self._key(spec), one), 0.0) for one in conditions]
        return sum(shares) / max(len(shares), 1)

    def best(self, spec: PolicySpec, condition: Condition) -> SuccessRate:
        """Whichever says more. They are not added up: workers begin with the shipped seeds."""
        known = NOTHING if condition.key() else self.shipped(spec).get(condition.subset, NOTHING)
        live = self.live(spec, condition)
        return live if live.n >= known.n else known

    def add(self, spec: PolicySpec, condition: Condition, outcomes: Mapping[int, bool]) -> None:
        """Takes outcomes by seed; calls the listeners if one of them is new."""
        self._add((self._key(spec), condition), outcomes)

    def _add(
        self, key: tuple[str, Condition], outcomes: Mapping[int, bool], error: str | None = None
    ) -> None:
        """``error``: why there will be no more of them; None: as it was."""
        with self._lock:
            before = self._live.get(key, {})
            error_before = self._errors.get(key, "")
            error = error_before if error is None else error
            news = not outcomes.items() <= before.items() or error_before != error
            others = {k: v for k, v in self._live.items() if k != key}
            for oldest in list(others)[: max(0, len(others) + 1 - MOST_CONDITIONS)]:
                del others[oldest]
            self._live = {**others, key: {**before, **outcomes}}
            self._errors = {k: v for k, v in self._errors.items() if k in others}
            self._errors |= {key: error} if error else {}
        if news:
            for listener in self._listeners:
                listener()

    @property
    def measures(self) -> bool:
        """Whether there are workers at all."""
        return self._evaluator is not None

    def want(self, visitor: Hashable, spec: PolicySpec, condition: Condition) -> None:
        """Has ``condition`` measured for ``visitor`` from now on, and not their last one. Where
        that cannot be, ``error`` says why."""
        if self._evaluator is None:
            return
        reference = self._reference(spec)
        try:
            self._hear(self._evaluator.request(visitor, reference, condition, spec))
        except UserError as error:
            self._evaluator.forget(visitor)
            self._add((self._key(spec), condition), {}, str(error))

    def forget(self, visitor: Hashable) -> None:
        """This visitor wants nothing measured any more, nor the B that they compare with."""
        if self._evaluator is not None:
            self._evaluator.forget(visitor)
            self._evaluator.forget(side_b(visitor))

    def error(self, spec: PolicySpec, condition: Condition) -> str:
        """Why a condition cannot be measured; empty while it can."""
        return self._errors.get((self._key(spec), condition), "")

    @property
    def trouble(self) -> str:
        """Why what is measured is gone when the page ends; '' where it is stored."""
        return self._evaluator.trouble if self._evaluator is not None else ""

    def close(self) -> None:
        """Ends the worker processes."""
        if self._evaluator is not None:
            self._evaluator.close()

    def _hear(self, tally: Tally) -> None:
        request = tally.request
        outcomes = {result.seed: result.success for result in tally.results}
        key = (request.digest or request.policy, request.condition)
        share = sum(result.outside for result in tally.results) / max(len(tally.results), 1)
        with self._lock:
            kept = {k: v for k, v in self._outside.items() if k in self._live}
            self._outside = {**kept, key: share}
        self._add(key, outcomes, tally.error)

    def _key(self, spec: PolicySpec) -> str:
        """The key of a policy's episodes: its version, or its reference where it has
        none. ``_hear`` finds the same in a request."""
        return spec.digest or self._reference(spec)

    def subscribe(self, listener: Callable[[], None]) -> None:
        """``listener`` is called whenever something was added, in whatever thread did it."""
        with self._lock:
            self._listeners = (*self._listeners, listener)

    def unsubscribe(self, listener: Callable[[], None]) -> None:
        """Does nothing for a listener that is none."""
        with self._lock:
            self._listeners = tuple(one for one in self._listeners if one != listener)


def side_b(visitor: Hashable) -> Hashable:
    """Who wants B measured while ``visitor`` compares."""
    return visitor, "B"
