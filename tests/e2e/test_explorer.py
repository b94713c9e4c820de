"""Looking back, another future, A against B, and a training: from what the page itself offers."""

from __future__ import annotations

from madviz.app.server import App
from madviz.session.commands import Pause, Reset, StepOnce
from madviz.session.session_reader import read_session
from tests.e2e.conftest import PATIENCE, Visitor
from tests.pages import sessions_shown


def open_tab(visitor: Visitor, *names: str) -> None:
    for name in names:
        visitor.page.get_by_role("tab", name=name, exact=True).click()


def paused_at(visitor: Visitor, app: App, step: int) -> None:
    """The seed again, and ``step`` decisions of it; a toy episode is too short to press pause in
    time on a busy machine."""
    (session,) = sessions_shown(app.users).values()
    for command in (Reset(), Pause(), *[StepOnce()] * step):
        session.send(command)
    visitor.until(f"status.phase === 'paused' && status.step === '{step}'")


def drag_back(visitor: Visitor, steps: int) -> None:
    """The timeline's slider, by keyboard."""
    slider = visitor.page.locator("[role=slider]:visible").last
    step = visitor.status("step")
    visitor.until(
        f"document.activeElement && [...document.querySelectorAll('[role=slider]')]"
        f".some(one => one.ariaValueNow === '{step}')"
    )
    slider.focus()
    for _ in range(steps):
        visitor.page.keyboard.press("ArrowLeft")


def test_looking_back_shows_an_earlier_step_and_newest_returns(visitor: Visitor, app: App):
    open_tab(visitor, "Go back")
    paused_at(visitor, app, 6)
    visitor.until_text(".mv-timeline", "Drag the step back")
    drag_back(visitor, 3)
    visitor.until("status.step === '3'")
    visitor.until_text(".mv-timeline", "Looking back: step 3 of 6")
    visitor.until_text(".mv-verdict", "LOOKING BACK")
    visitor.press("newest")
    visitor.until("status.step === '6'")


def test_a_camera_switched_off_in_the_past_begins_another_future(visitor: Visitor, app: App):
    open_tab(visitor, "Go back")
    paused_at(visitor, app, 5)
    drag_back(visitor, 3)
    visitor.until("status.step === '2'")
    visitor.press("off", camera=1)
    visitor.until("status.setting === 'first+third_b' && status.step === '2'")
    visitor.press("step")
    visitor.until("status.step === '3'")
    text = visitor.until_text(".mv-timeline", "forked at step 2")
    assert "original run" in text and "up to step 5" in text


def test_a_against_b_counts_pairs(visitor: Visitor):
    open_tab(visitor, "Who wins?")
    visitor.until_text(".mv-comparison", "A is the page")
    visitor.press("start B")
    visitor.until_text(".mv-comparison", "None yet")
    visitor.press("max")
    text = visitor.until_text(".mv-comparison", "n = [1-9][0-9]* pairs")
    assert "both" in text and "95 %; p = " in text
    visitor.press("end B")
    visitor.until_text(".mv-comparison", "A is the page")


def test_a_training_starts_shows_itself_and_stops(visitor: Visitor):
    open_tab(visitor, "More", "Train")
    visitor.until_text(".mv-training", "Nothing is being trained")
    visitor.press("watch")
    visitor.page.get_by_text("expected a policy to watch").wait_for(timeout=PATIENCE)
    visitor.press("start")
    visitor.until_text(".mv-training", "Training")
    visitor.press("pause")  # It has the machine to itself, and is followed all the same.
    visitor.press("stop")
    visitor.until_text(".mv-training", "Stopping|Stopped")
    # A round is finished first, by a process that lets everything else go before it.
    visitor.until_text(".mv-training", "Stopped", patience=5 * PATIENCE)


def test_shapley_values_of_all_cameras_stand_in_a_table(visitor: Visitor):
    open_tab(visitor, "What counts?")
    text = visitor.until_text(".mv-shapley", "none → all present")
    assert all(word in text for word in ("Q now", "First person", "Third A", "Third B"))
    assert "dropped" not in text
    visitor.press("off", camera=1)
    text = visitor.until_text(".mv-shapley", "Third A · dropped")
    assert "First person · dropped" not in text


def test_saliency_is_asked_for_and_answered(visitor: Visitor, app: App):
    open_tab(visitor, "Sees what?")
    visitor.until_text(".mv-saliency", "Shows on every picture")
    paused_at(visitor, app, 3)
    visitor.press("for its action")
    visitor.until_text(".mv-saliency", "a policy not made with torch never has one")
    visitor.page.locator("[data-mv-grid=saliency] button").first.click()
    visitor.until_text(".mv-saliency", "Shows on every picture")


def test_a_scenario_runs_as_planned_and_ends(visitor: Visitor):
    open_tab(visitor, "More", "Failures")
    visitor.page.get_by_text("No failures are planned").wait_for(timeout=PATIENCE)
    visitor.press("run scenario")
    visitor.page.get_by_text("One camera after another is lost").wait_for(timeout=PATIENCE)
    visitor.until("status.setting === 'first+third_b'")
    visitor.until("status.setting === 'first'")
    visitor.press("end it")
    visitor.page.get_by_text("No failures are planned").wait_for(timeout=PATIENCE)


def test_a_session_is_saved_as_a_file_that_replays(visitor: Visitor, app: App, tmp_path):
    open_tab(visitor, "More", "Save")
    paused_at(visitor, app, 4)
    with visitor.page.expect_download(timeout=PATIENCE) as download:
        visitor.page.get_by_role("button", name="save this episode").click()
    path = tmp_path / download.value.suggested_filename
    download.value.save_as(path)
    (episode,) = read_session(path).episodes
    assert (episode.task, episode.steps) == ("toy/reach", 4)
