"""Presenting, tokens, the tour, the help, light and dark, and a phone, in a real browser."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from madviz.app.access import Gate
from madviz.app.server import App
from tests.e2e.conftest import PATIENCE, Visitor, open_page, toy_app, wait_until

EVERYBODY = "visitors", "presenter"


@pytest.fixture(scope="module")
def presentation() -> Iterator[App]:
    app = toy_app(visitors=4, gate=Gate(*EVERYBODY))
    yield app
    app.stop()


def test_without_the_token_one_sees_a_form_and_nothing_else(browser, presentation: App):
    page = browser.new_context().new_page()
    page.goto(presentation.url)
    page.get_by_text("needs the token").wait_for()
    page.wait_for_timeout(1000)
    assert page.locator(".mv-status, .mv-mosaic, canvas").count() == 0
    assert not presentation.server.get_clients()
    page.get_by_label("Token").fill("not this")
    page.get_by_role("button", name="open").click()
    page.get_by_text("not the token").wait_for()
    page.get_by_label("Token").fill("visitors")
    page.get_by_role("button", name="open").click()
    page.wait_for_selector(".mv-status", timeout=PATIENCE)
    assert "token" not in page.url
    page.context.close()


def test_the_presenter_has_the_controls_also_after_a_reload(browser, presentation: App):
    presenter = open_page(browser, presentation.addresses()["present at"])
    watcher = open_page(browser, presentation.addresses()["watch at"])
    assert watcher.page.get_by_role("button", name="off", exact=True).count() == 0
    assert watcher.page.get_by_role("button", name="tour").count() == 0
    assert watcher.page.get_by_text("the presenter has the controls").is_visible()
    presenter.press("off", camera=1)
    watcher.until("status.setting === 'first+third_b'")
    presenter.page.reload()
    presenter.page.wait_for_selector(".mv-status", timeout=PATIENCE)
    presenter.until("status.setting === 'first+third_b'")
    presenter.press("on", camera=1)
    watcher.until("status.setting === 'all'")
    watcher.page.mouse.click(800, 700)
    watcher.page.keyboard.press("2")
    watcher.page.wait_for_timeout(500)
    assert watcher.status("setting") == "all"
    presenter.close()
    watcher.close()
    wait_until(lambda: not presentation.server.get_clients())


def test_the_tour_does_what_it_says_and_can_be_left(visitor: Visitor):
    visitor.press("tour")
    visitor.until_text(".mv-tour", "1 of 7")
    visitor.press("next step")
    visitor.until_text(".mv-tour", "2 of 7")
    visitor.until("status.setting === 'first+third_b'")
    visitor.press("end the tour")
    visitor.until("status.setting === 'all' && !document.querySelector('.mv-tour')")


def test_the_question_mark_opens_help_where_the_page_turns_light(visitor: Visitor):
    page = visitor.page
    page.mouse.click(800, 700)
    page.keyboard.press("?")
    dialog = page.get_by_role("dialog")
    dialog.get_by_text("Drop Third A").wait_for(timeout=PATIENCE)
    assert "space" in dialog.inner_text() and "merged" in dialog.inner_text()
    for scheme in ("light", "dark"):
        dialog.get_by_role("button", name=scheme, exact=True).click()
        visitor.until(f"document.documentElement.dataset.mantineColorScheme === '{scheme}'")
        assert contrast(page, ".mv-status b") > 4.5
        assert contrast(page, ".mv-status .dim") > 4.5
    dialog.get_by_role("button", name="close", exact=True).click()
    dialog.wait_for(state="hidden")


def contrast(page, selector: str) -> float:
    """Of a text on whatever is behind it, by the rule of WCAG 2: 1 to 21, readable from 4.5."""
    return page.evaluate(
        """selector => {
          const element = document.querySelector(selector);
          const parts = text => text.match(/[\\d.]+/g).map(Number);
          const light = ([r, g, b]) => [r, g, b].map(v => v / 255)
            .map(v => v <= 0.04 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
            .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
          let behind = element;
          const ground = one => parts(getComputedStyle(one).backgroundColor);
          while (behind && (ground(behind)[3] ?? 1) < 0.99) behind = behind.parentElement;
          const two = [light(parts(getComputedStyle(element).color)), light(ground(behind))];
          return (Math.max(...two) + 0.05) / (Math.min(...two) + 0.05);
        }""",
        selector,
    )


def test_a_phone_shows_status_and_pictures_first(browser, app: App):
    context = browser.new_context(
        viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True
    )
    page = context.new_page()
    page.goto(app.url + "?fixedDpr=0.25")
    page.wait_for_selector("[data-mv-phone]", timeout=PATIENCE)
    for part in (".mv-status", ".mv-mosaic"):  # The page lays itself out once it knows the phone.
        page.wait_for_function(
            """part => {
              const box = document.querySelector(part)?.getBoundingClientRect();
              return box && box.width > 0 && box.x >= 0 && box.right <= 391
                && box.y >= 0 && box.bottom <= 844;
            }""",
            arg=part,
            timeout=PATIENCE,
        )
    assert page.locator(".mv-mosaic").bounding_box()["width"] > 320
    step = page.locator(".mv-status").get_attribute("data-step")
    page.wait_for_function(
        f"() => document.querySelector('.mv-status').dataset.step !== '{step}'", timeout=PATIENCE
    )
    context.close()
