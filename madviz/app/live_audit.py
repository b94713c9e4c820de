"""An audit on the page: one for the whole server, whoever started it.

It asks for what ``madviz.measure.audit`` wants next, one condition after the other, as if it were
one more visitor: worker processes take turns between it and the others, and what they measured for
anybody counts for all. A thread of its own decides what comes next, so that no page waits for it.

    wanted by the plan ─► SuccessRates.want ─► workers ─► outcomes by seed ─► wanted by the plan
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from madviz.app.rates import SuccessRates
from madviz.errors import UserError
from madviz.measure.audit.conditions import Cameras, Played
from madviz.measure.audit.plan import AuditPlan
from madviz.measure.audit.result import AuditFile, result
from madviz.measure.episodes import FIRST_SEED
from madviz.observation.ablation import Ablation
from madviz.policies.config import definition_of
from madviz.session.frame import Frame, condition_of
from madviz.subsets import mask_of
from madviz.types import Array, PolicySpec

State = Literal["idle", "running", "stopped", "failed", "done"]
LOOK_AGAIN = 5.0
"""Seconds after which it looks again for outcomes, also without having heard of any."""


@dataclass(frozen=True)
class AuditStatus:
    """What is known at one moment; never changes."""

    state: State = "idle"
    policy: PolicySpec | None = None
    plan: AuditPlan | None = None
    outcomes: dict[Played, dict[int, bool]] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    found: AuditFile | None = None
    """When it is done."""
    why: str = ""
    """Why it failed."""

    @property
    def share(self) -> float:
        """Of the planned episodes, in [0, 1]; an audit that stops early gets to 1 at once."""
        if self.plan is None or self.state == "done":
            return float(self.state == "done")
        end = self.plan.stopped(self.outcomes)
        episodes = end[0].episodes if end else self.plan.episodes
        have = sum(
            seed in self.outcomes.get(played, {})
            for played in self.plan.every
            for seed in self.plan.seeds(episodes)
        )
        return have / (episodes * len(self.plan.every))


class LiveAudit:
    """See the module. Everybody may call everything, from any thread."""

    def __init__(self, rates: SuccessRates) -> None:
        self._rates = rates
        self._lock = threading.Lock()
        self._news, self._ended = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._status = AuditStatus()
        self._facts: dict[str, Any] = {}

    @property
    def measures(self) -> bool:
        """Whether there are workers to play episodes."""
        return self._rates.measures

    def status(self) -> AuditStatus:
        """Now."""
        return self._status

    def start(self, frame: Frame, episodes: int) -> None:
        """Audits the policy of ``frame``. Raises UserError while one runs, and without workers."""
        if not self.measures:
            raise UserError("expected worker processes, found none; start with --workers 1")
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                raise UserError("an audit is running already; stop it first, or wait for it")
            spec, env = frame.world.policy, frame.world.env
            labels = {camera.name: camera.label for camera in env.cameras}
            cameras = Cameras(spec.streams, _supports(frame))
            plan = AuditPlan(cameras, episodes, FIRST_SEED)
            self._facts = {
                "policy": spec.name,
                "task": spec.task,
                "digest": spec.digest,
                "definition": definition_of(env),
                "labels": labels,
            }
            self._status = AuditStatus("running", spec, plan, {}, labels)
            self._ended = threading.Event()
            self._thread = threading.Thread(
                target=self._run, args=(self._ended,), name="madviz-audit", daemon=True
            )
            self._thread.start()

    def stop(self) -> None:
        """What was measured stays; started again, it goes on from there."""
        self._ended.set()
        self._news.set()

    def close(self) -> None:
        """Stops, and waits for the thread."""
        self.stop()
        if self._thread is not None:
            self._thread.join()

    def _run(self, ended: threading.Event) -> None:
        self._rates.subscribe(self._news.set)
        try:
            while self._status.state == "running" and not ended.is_set():
                self._news.clear()
                self._status = self._next()
                if self._status.state == "running":
                    self._news.wait(LOOK_AGAIN)
        except Exception as error:  # The page says so; the server lives.
            said = str(error) or type(error).__name__
            self._status = replace(self._status, state="failed", why=said)
        finally:
            self._rates.unsubscribe(self._news.set)
            self._rates.forget(self)
            if self._status.state == "running":
                self._status = replace(self._status, state="stopped")

    def _next(self) -> AuditStatus:
        """Asks for what is to be played now; the status with what is known."""
        status = self._status
        spec, plan = status.policy, status.plan
        assert spec is not None and plan is not None
        asked = {played: _given(played, spec) for played in plan.every}
        outcomes = {
            played: dict(self._rates.outcomes(spec, condition_of(ablation, spec.streams)))
            for played, (_, ablation) in asked.items()
        }
        status = replace(status, outcomes=outcomes)
        missing = {played for played, _ in plan.wanted(outcomes)}
        if not missing:
            return replace(status, state="done", found=result(plan, outcomes, self._facts))
        mask, ablation = asked[next(played for played in plan.every if played in missing)]
        self._rates.want(self, spec, mask, ablation)
        why = self._rates.error(spec, condition_of(ablation, spec.streams))
        return replace(status, state="failed", why=why) if why else status


def _given(played: Played, spec: PolicySpec) -> tuple[Array, Ablation]:
    """The streams (V,) bool that are present, and what happens to cameras."""
    mask = mask_of(played.subset, spec.streams)
    return mask, Ablation.from_mask(mask, spec.streams, dict(played.occlusions))


def _supports(frame: Frame) -> Callable[[Array], bool]:
    probe = frame.world.probe
    return lambda mask: bool(probe.supported[probe.row(mask)])
