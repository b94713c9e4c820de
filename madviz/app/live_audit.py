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
from typing import Literal

from madviz.app.success_rates import SuccessRates
from madviz.errors import UserError
from madviz.measure.audit.document import AuditFile, audit_document
from madviz.measure.audit.lost_cameras import Cameras
from madviz.measure.audit.schedule import AuditPlan
from madviz.measure.episodes import FIRST_SEED
from madviz.observation.condition import Condition
from madviz.session.frame import Frame
from madviz.types import Array, EnvSpec, PolicySpec

State = Literal["idle", "running", "stopped", "failed", "done"]
LOOK_AGAIN = 5.0
"""Seconds after which it looks again for outcomes, also without having heard of any."""


@dataclass(frozen=True)
class AuditStatus:
    """The state of an audit at one moment; never changes."""

    state: State = "idle"
    policy: PolicySpec | None = None
    plan: AuditPlan | None = None
    outcomes: dict[Condition, dict[int, bool]] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    found: AuditFile | None = None
    """When it is done."""
    why: str = ""
    """Why it failed."""

    @property
    def share(self) -> float:
        """The part of the planned episodes that is played, in [0, 1]; an audit that stops early
        gets to 1 at once."""
        if self.plan is None or self.state == "done":
            return float(self.state == "done")
        end = self.plan.stopped(self.outcomes)
        episodes = end[0].episodes if end else self.plan.episodes
        have = sum(
            seed in self.outcomes.get(condition, {})
            for condition in self.plan.every
            for seed in self.plan.seeds(episodes)
        )
        return have / (episodes * len(self.plan.every))


class LiveAudit:
    """See the module. Everybody may call everything, from any thread."""

    def __init__(self, rates: SuccessRates) -> None:
        self._rates = rates
        self._lock = threading.Lock()
        self._news = threading.Event()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._status = AuditStatus()
        self._env: EnvSpec | None = None

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
            spec = frame.world.policy
            plan = AuditPlan(Cameras(spec.streams, _supports(frame)), episodes, FIRST_SEED)
            self._env = frame.world.env
            labels = {camera.name: camera.label for camera in self._env.cameras}
            self._status = AuditStatus("running", spec, plan, {}, labels)
            self._ended = threading.Event()
            self._thread = threading.Thread(
                target=self._run, args=(self._ended,), name="madviz-audit", daemon=True
            )
            self._thread.start()

    def stop(self) -> None:
        """Stops the audit. Its episodes stay; started again, it goes on from there."""
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
            why = str(error) or type(error).__name__
            self._status = replace(self._status, state="failed", why=why)
        finally:
            self._rates.unsubscribe(self._news.set)
            self._rates.forget(self)
            if self._status.state == "running":
                self._status = replace(self._status, state="stopped")

    def _next(self) -> AuditStatus:
        """Asks for what is to be played now; the status with what is known."""
        status = self._status
        spec = status.policy
        plan = status.plan
        assert spec is not None and plan is not None and self._env is not None
        outcomes = {
            condition: dict(self._rates.outcomes(spec, condition)) for condition in plan.every
        }
        status = replace(status, outcomes=outcomes)
        missing = {condition for condition, _ in plan.wanted(outcomes)}
        if not missing:
            outside = self._rates.outside(spec, plan.every)
            document = audit_document(plan, outcomes, spec, self._env, outside)
            return replace(status, state="done", found=document)
        condition = next(condition for condition in plan.every if condition in missing)
        self._rates.want(self, spec, condition)
        why = self._rates.error(spec, condition)
        return replace(status, state="failed", why=why) if why else status


def _supports(frame: Frame) -> Callable[[Array], bool]:
    probe = frame.world.probe
    return lambda mask: bool(probe.supported[probe.row(mask)])
