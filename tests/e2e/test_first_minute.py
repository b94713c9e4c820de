"""The first minute: two policies are offered side by side, a camera goes, nothing is scrolled."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from madviz.app.layout import Shared
from madviz.app.panels.policy import PolicyChoice
from madviz.app.server import App
from madviz.app.users import Limits
from madviz.envs.registry import make_env
from madviz.session.session import Session
from tests.e2e.conftest import PATIENCE, Visitor, open_page, wait_until
from tests.fakes import FakePolicy

PAIR = {
    "toy-mad-light": FakePolicy("toy-mad-light"),
    "toy-merged-only-light": FakePolicy("toy-merged-only-light", method="merged-only", seed=1),
}


@pytest.fixture(scope="module")
def greeting_app() -> Iterator[App]:
    choices = [PolicyChoice(name, name, "toy/reach") for name in PAIR]

    def new_session() -> Session:
        return Session(make_env, PAIR["toy-mad-light"], PAIR.__getitem__)

    app = App(new_session, Shared(choices), Limits(2))
    yield app
    app.stop()


@pytest.fixture
def newcomer(browser, greeting_app: App) -> Iterator[Visitor]:
    visitor = open_page(browser, greeting_app.url)
    yield visitor
    visitor.close()


def dropped(visitor: Visitor) -> list[bool]:
    """Whether the first camera is dropped on A's picture and on B's: its middle is grey."""
    return visitor.page.evaluate(
        """() => [...document.querySelectorAll('.mv-mosaic')].map(image => {
          const canvas = document.createElement('canvas').getContext('2d');
          const side = image.naturalHeight - 24, left = (image.naturalWidth / 3 - side) / 2;
          canvas.drawImage(image, left + side / 4, 24 + side * 0.7, side / 2, side / 5, 0, 0, 9, 9);
          const data = canvas.getImageData(0, 0, 9, 9).data;
          return [...Array(81).keys()].every(i => Math.abs(data[4 * i] - data[4 * i + 2]) < 16);
        })"""
    )


def test_a_comparison_is_offered_first_and_drops_a_camera_on_both_sides(newcomer: Visitor):
    page = newcomer.page
    newcomer.press("just show me")
    page.wait_for_selector(".mv-side", timeout=PATIENCE)
    assert page.locator(".mv-side").count() == 2
    first, second = (box.bounding_box() for box in page.locator(".mv-mosaic").all())
    assert (first["width"], first["height"]) == (second["width"], second["height"])
    newcomer.until("status.setting === 'third_a+third_b'")
    wait_until(lambda: dropped(newcomer) == [True, True])
    assert page.locator(".mv .rate b", has_text="B").first.is_visible()
    newcomer.press("next step")
    newcomer.press("next step")
    newcomer.until("status.setting === 'all'")
    newcomer.press("keep comparing")
    newcomer.press("off")
    newcomer.until_text(".mv-words", "A's action changed .* B's action changed")
    newcomer.press("A only")
    newcomer.press("on")
    newcomer.until("status.setting === 'all'")
    wait_until(lambda: dropped(newcomer) == [False, True])
    newcomer.press("A and B")
    wait_until(lambda: dropped(newcomer) == [False, False])
    newcomer.press("end comparison")
    page.wait_for_function("() => !document.querySelector('.mv-side')", timeout=PATIENCE)


def test_at_1280_by_800_the_comparison_needs_no_scrolling(newcomer: Visitor):
    page = newcomer.page
    newcomer.press("just show me")
    page.wait_for_selector(".mv-side", timeout=PATIENCE)
    page.get_by_role("tab", name="Who wins?").click()
    page.wait_for_function(
        """() => ['.mv-side', '.mv-words', '.mv-comparison', '.mv .rate', '.mv .mv-outcomes']
          .every(selector => {
            const last = [...document.querySelectorAll(selector)].at(-1)?.getBoundingClientRect();
            return last && last.height > 0 && last.bottom <= 800;
          })""",
        timeout=PATIENCE,
    )


def test_one_click_leads_to_plain_exploring_and_no_note_hides_the_scene(newcomer: Visitor):
    page = newcomer.page
    newcomer.press("explore one policy")
    offer = page.get_by_role("button", name="just show me")
    offer.wait_for(state="detached", timeout=PATIENCE)
    assert page.locator(".mv-side").count() == 0
    page.wait_for_selector(".mv-gpu", timeout=PATIENCE)
    page.wait_for_function(
        "() => !document.querySelector('.mantine-Notification-root')", timeout=PATIENCE
    )


def test_on_a_phone_the_opening_is_on_top(browser, greeting_app: App):
    context = browser.new_context(viewport={"width": 390, "height": 844})
    page = context.new_page()
    page.goto(greeting_app.url + "?fixedDpr=0.25")
    page.wait_for_selector("[data-mv-phone] .mv-tour", timeout=PATIENCE)
    page.wait_for_function(
        """() => {
          const tops = ['canvas', '.mv-tour', '.mv-status', '.mv-mosaic']
            .map(name => document.querySelector(name).getBoundingClientRect().top);
          return tops.every((top, i) => i === 0 || top > tops[i - 1]) && tops[1] < 600;
        }""",
        timeout=PATIENCE,
    )
    context.close()
