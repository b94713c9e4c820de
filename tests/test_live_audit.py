"""The audit on the page: what it asks of the workers, and what it shows meanwhile."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

from madviz.app.live_audit import AuditStatus, LiveAudit
from madviz.app.panels.audit import AuditPanel, audit_html
from madviz.app.success_rates import SuccessRates
from madviz.errors import UserError
from madviz.measure.audit.audit import audit
from madviz.measure.audit.schedule import AuditPlan
from madviz.measure.episodes import FIRST_SEED
from madviz.measure.live import Request, Tally
from madviz.measure.store import EpisodeResult
from madviz.observation.condition import Condition
from tests.fakes import FakePolicy
from tests.pages import recorded, use
from tests.sessions import frame_with

FRAME = frame_with()
SPEC = FRAME.world.policy


class Measured:
    """Stands for the evaluator: at every request it knows ``step`` episodes more."""

    trouble = ""

    def __init__(self, listener, step=100, error=""):
        self.listener, self.step, self.error = listener, step, error
        self.known, self.asked, self.left = {}, [], []

    def request(self, visitor, policy, condition, digest=None):
        request = Request(str(policy), SPEC.digest, condition)
        self.asked.append(condition)
        seeds = self.known.setdefault(request, [])
        seeds += range(len(seeds), len(seeds) + self.step)
        results = tuple(
            EpisodeResult(
                condition.subset, FIRST_SEED + i, self.success(condition, i), False, 0.0, 0.25
            )
            for i in seeds
        )
        return Tally(request, results, self.error)

    @staticmethod
    def success(condition, number):
        """First person decides; whatever happens to it."""
        blind = [camera for camera, _ in condition.occlusions]
        there = condition.subset == "all" or "first" in condition.subset
        return there and "first" not in blind and number % 20 != 0

    def forget(self, visitor):
        self.left.append(visitor)

    def close(self):
        pass


def live(**how):
    made = []

    def make(listener):
        made.append(Measured(listener, **how))
        return made[0]

    rates = SuccessRates(make_evaluator=make)
    return LiveAudit(rates), made[0]


def ended(audit_, seconds=30.0):
    """The status when it no longer runs."""
    until = time.monotonic() + seconds
    while audit_.status().state == "running" and time.monotonic() < until:
        time.sleep(0.01)
    return audit_.status()


def test_it_comes_to_what_the_command_comes_to(monkeypatch):
    running, workers = live()
    running.start(FRAME, 100)
    status = ended(running)
    assert status.state == "done" and status.share == 1.0 and status.found is not None
    assert status.found["verdict"] == {
        "first": "needed",
        "third_a": "no use shown",
        "third_b": "no use shown",
    }
    assert running in workers.left

    def play(jobs, count, here, progress):
        for job in jobs:
            good = workers.success(job.condition, job.seed - FIRST_SEED)
            yield job, (EpisodeResult(job.condition.subset, job.seed, good, good, 0.0, 0.25), "")

    monkeypatch.setattr("madviz.measure.table.run_anywhere", play)
    assert audit(FakePolicy(), episodes=100) == status.found
    assert status.found.get("outside") == 0.25


def test_what_verdicts_rest_on_is_asked_for_first_and_a_condition_at_a_time():
    running, workers = live(step=10)
    running.start(FRAME, 20)
    assert ended(running).state == "done"
    plan = status_plan(running)
    order = list(dict.fromkeys(workers.asked))
    assert order == list(plan.every)
    assert workers.asked[:3] == [Condition("all")] * 2 + [Condition("third_a+third_b")]


def status_plan(running) -> AuditPlan:
    plan = running.status().plan
    assert plan is not None
    return plan


def test_one_at_a_time_and_none_without_workers():
    running, workers = live(step=0)
    running.start(FRAME, 20)
    with pytest.raises(UserError, match="running already"):
        running.start(FRAME, 20)
    running.close()
    assert running.status().state == "stopped" and running in workers.left
    workers.step = 100
    running.start(FRAME, 20)
    assert ended(running).state == "done"
    with pytest.raises(UserError, match="--workers 1"):
        LiveAudit(SuccessRates()).start(FRAME, 20)


def test_an_error_ends_it_with_a_word():
    running, _ = live(step=0, error="cannot act on 'all'")
    running.start(FRAME, 20)
    status = ended(running)
    assert (status.state, status.why) == ("failed", "cannot act on 'all'")
    assert "It failed:" in audit_html(FRAME, status) and "cannot act on" in audit_html(
        FRAME, status
    )


def test_the_panel_fills_as_episodes_finish():
    assert "Workers play the same scenes" in audit_html(FRAME, AuditStatus())
    assert "--workers is 0" in audit_html(FRAME, AuditStatus(), measures=False)
    running, _ = live()
    running.start(FRAME, 40)
    done = ended(running)
    text = audit_html(FRAME, done)
    assert 'data-state="done"' in text and "First person is needed" in text
    assert text.count("<tr>") == 7 and "<b>needed</b>" in text
    assert done.plan is not None
    few = {played: dict(list(seeds.items())[:20]) for played, seeds in done.outcomes.items()}
    part = AuditStatus("running", done.policy, done.plan, few, done.labels)
    assert 0.3 < part.share < 1
    assert "needed so far" in audit_html(FRAME, part)
    nothing = AuditStatus("running", done.policy, done.plan, {}, done.labels)
    assert "so far" not in audit_html(FRAME, nothing) and nothing.share == 0


def test_a_policy_cannot_break_the_page_with_its_name():
    running, _ = live()
    running.start(FRAME, 20)
    done = ended(running)
    labels = {name: "<script>" for name in done.labels}
    assert "<script>" not in audit_html(
        FRAME, AuditStatus("running", done.policy, done.plan, done.outcomes, labels)
    )
    assert np.isfinite(done.share)


def test_only_a_number_that_is_offered_begins_an_audit(server):
    begun: list[int] = []
    audit_ = SimpleNamespace(
        measures=True,
        status=AuditStatus,
        start=lambda frame, episodes: begun.append(episodes),
        stop=lambda: None,
    )
    gui = recorded(server.gui)
    panel = AuditPanel(gui, lambda: FRAME, FRAME, audit_)  # type: ignore[arg-type]
    for value in ("1000000000", "all", "50"):
        use(gui.find("Episodes"), value)
        use(gui.find("start audit"))
    assert begun == [50]
    panel.remove()
