"""The audit on a real page: started there, filled as episodes finish."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from madviz.app.layout import Shared
from madviz.app.server import App
from madviz.app.success_rates import SuccessRates
from madviz.app.users import Limits
from madviz.envs.registry import make_env
from madviz.session.session import Session
from madviz.training.job import TrainingJob
from tests.e2e.conftest import Visitor
from tests.fakes import policies
from tests.pages import choices_of
from tests.test_live_audit import Measured


def test_an_audit_is_started_on_the_page_and_comes_to_verdicts(
    visit: Callable[[str], Visitor],
) -> None:
    def new_session() -> Session:
        return Session(make_env, policies("toy-mad"), policies)

    rates = SuccessRates(make_evaluator=lambda listener: Measured(listener))  # type: ignore
    training = TrainingJob(Path(tempfile.mkdtemp(prefix="madviz-runs-")))
    shared = Shared(choices_of("toy-mad"), rates, training)
    app = App(new_session, shared, Limits(1))
    try:
        visitor = visit(app.url)
        visitor.page.get_by_role("tab", name="More").click()
        visitor.page.get_by_role("tab", name="Audit").click()
        tabs = [tab.bounding_box() for tab in visitor.page.get_by_role("tab").all()]
        visitor.until_text(".mv-audit", "Does this policy use its cameras")
        visitor.press("start audit")
        visitor.until_text(".mv-audit", "First person is needed: without it success changes by -")
        assert visitor.page.locator(".mv-audit").get_attribute("data-state") == "done"
        rows = {round(box["y"]) for box in tabs[1:] if box}
        assert len(rows) == 2, "questions stand in one row, and what More has in another"
    finally:
        app.stop()
