"""Lesson 0 in a real Chromium, with a fake worker: a prediction, the robots, two exercises."""

from __future__ import annotations

from pathlib import Path

from tests.e2e.conftest import PICTURES
from tests.e2e.static_site import MERGED_ONLY, fake_site, served


def test_a_student_predicts_looks_and_answers(browser, tmp_path: Path) -> None:
    with served(fake_site(tmp_path / "site")) as address:
        page = browser.new_context(viewport={"width": 1000, "height": 1600}).new_page()
        complaints: list[str] = []
        page.on("console", lambda one: one.type == "error" and complaints.append(one.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        try:
            page.goto(f"{address}lesson.html")
            why = page.get_by_text("Merged Only was trained on the sum")
            assert not why.is_visible(), "the answer, before a prediction"
            page.get_by_label("One goes on, the other fails").check()
            page.get_by_role("button", name="Show the robots").click()
            page.get_by_text("You predicted: One goes on, the other fails.").wait_for()
            said = (
                "First person was dropped at step 15. MAD drove the nail in, Merged Only did not. "
            )
            page.get_by_text(
                f"{said}You predicted: One goes on, the other fails, and so it was."
            ).wait_for()
            assert page.frame_locator("iframe").locator("#line").inner_text().startswith(said)
            page.get_by_label("Both go on").check()
            page.get_by_role("button", name="Show the robots").click()
            page.get_by_text(
                f"{said}You predicted: Both go on, and it was: One goes on, the other fails."
            ).wait_for()

            rates, link = page.locator("#rates"), page.locator("#link")
            rates.get_by_role("button").click()
            rates.get_by_text("Hint 1 of 3").wait_for()
            rates.get_by_label("MAD").fill("0")
            rates.get_by_label("Merged Only").fill("1")
            rates.get_by_role("button").click()
            rates.get_by_text("The two have changed places.").wait_for()
            assert "Hint 2 of 3" in rates.inner_text() and "Hint 3" not in rates.inner_text()
            rates.get_by_label("MAD").fill("1.00")
            rates.get_by_label("Merged Only").fill("0.00")
            rates.get_by_role("button").click()
            rates.get_by_text("Right.", exact=True).wait_for()
            assert "Hint" not in rates.inner_text()

            link.get_by_label("Link").fill(f"#policy={MERGED_ONLY}&third_a=off@20")
            link.get_by_label("Link").press("Enter")
            link.get_by_text("Off leaves the sum").wait_for()
            PICTURES.mkdir(parents=True, exist_ok=True)
            page.screenshot(path=PICTURES / "site-lesson.png", full_page=True)
            link.get_by_label("Link").fill(f"#policy={MERGED_ONLY}&third_a=black@20")
            link.get_by_label("Link").press("Enter")
            link.get_by_text("Right.", exact=True).wait_for()
            page.get_by_text("Open this once").click()
            assert why.is_visible()
            assert complaints == []
        finally:
            page.context.close()
