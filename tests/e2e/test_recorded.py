"""Recordings in a real browser: pictures where the scene is, distances where success is."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from madviz.app.server import App, ExploreConfig, open_app
from madviz.recorded.known import LABEL, VARIABLE
from tests.e2e.conftest import PATIENCE, Visitor
from tests.recordings import Small


@pytest.fixture(params=["", "tests.recorded_policy:make"], ids=["alone", "policy"])
def served(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[App, str]]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(VARIABLE, "")
    name = "policy" if request.param else "alone"  # The fork server still knows the other one.
    folder = Small(steps=40).write(tmp_path / name)
    policy = request.param or None
    app = open_app(ExploreConfig(policy=policy, port=0, recording=folder, seed=1))
    yield app, request.param
    app.stop()


def test_a_recording_plays_and_says_that_actions_change_nothing(
    served: tuple[App, str], visit: Callable[[str], Visitor]
) -> None:
    app, policy = served
    visitor = visit(app.url)
    page = visitor.page
    visitor.until_text(".mv-recorded", LABEL)
    visitor.until("Number(status.step) >= 3")
    visitor.press("off")
    visitor.until("status.setting === 'wrist'")
    if policy:
        text = visitor.until_text(".mv-apart", "with and without Top")
        assert "the policy from the recording" in text
    else:
        assert not page.get_by_role("tab", name="What if?").count()
    page.get_by_role("tab", name="Go back").click(timeout=PATIENCE)
    visitor.until_text(".mv-timeline", "apart")
    assert not re.search(r"success|goal met", page.inner_text("body"), re.IGNORECASE)
