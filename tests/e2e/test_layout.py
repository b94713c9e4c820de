"""The room that the scene has, and the page on a phone."""

from __future__ import annotations

import pytest

from madviz.app.server import App
from tests.e2e.conftest import PATIENCE, Visitor

SCENE = """() => [...document.querySelectorAll('canvas')].map(one => one.getBoundingClientRect())
  .reduce((most, one) => one.height > most.height ? one : most).width / innerWidth"""
"""The scene's share of the window's width; its canvas is the highest one."""

SIDEWAYS = """() => [...document.querySelectorAll('*')].filter(one => one.checkVisibility()
  && (one.scrollWidth > one.clientWidth + 1
      && /auto|scroll/.test(getComputedStyle(one).overflowX)
    || one.matches('button, input, img') && one.getBoundingClientRect().right > 391)
  && one.getBoundingClientRect().width > 1).map(one => one.outerHTML.slice(0, 90))"""
"""What can be scrolled to the side on a phone, or lies outside of its screen."""


def sized(browser, app: App, width: int, height: int, dpr: float = 0.25) -> Visitor:
    """A visitor with a window of that size; viser knows it in pixels that are drawn, ``dpr``."""
    context = browser.new_context(viewport={"width": width, "height": height})
    page = context.new_page()
    page.goto(f"{app.url}?fixedDpr={dpr}")
    page.wait_for_selector(".mv-mosaic", timeout=PATIENCE)
    return Visitor(page)


@pytest.mark.parametrize("width, height, share", [(1280, 800, 0.4), (1920, 1080, 0.5)])
def test_the_scene_has_its_share_of_the_width(browser, app: App, width, height, share):
    visitor = sized(browser, app, width, height, dpr=1)
    visitor.page.wait_for_function(f"() => ({SCENE})() < 0.9", timeout=PATIENCE)
    assert visitor.page.evaluate(SCENE) >= share
    picture = visitor.page.locator(".mv-mosaic").first.bounding_box()
    assert picture is not None and picture["width"] > (600 if width > 1600 else 400)
    visitor.page.get_by_role("tab", name="More").wait_for()
    tabs = [tab.bounding_box() for tab in visitor.page.get_by_role("tab").all()]
    assert len({round(box["y"]) for box in tabs[1:] if box}) == 1, "the tabs stand in one row"
    visitor.close()


def test_a_phone_has_the_scene_above_and_nothing_to_scroll_sideways(browser, app: App):
    visitor = sized(browser, app, 390, 844)
    page = visitor.page
    page.wait_for_selector("[data-mv-phone]", timeout=PATIENCE)
    page.wait_for_function("() => document.querySelectorAll('[data-mv-grid=cameras]').length")
    visitor.press("break …", camera=1)
    page.locator("[data-mv-grid=breaks]").wait_for(timeout=PATIENCE)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
    page.wait_for_function(f"() => ({SIDEWAYS})().length === 0", timeout=PATIENCE)
    tops = page.evaluate(
        """() => ['canvas', '.mv-status', '.mv-mosaic', '[data-mv-grid=cameras] button']
          .map(name => document.querySelector(name).getBoundingClientRect().top)"""
    )
    assert tops == sorted(tops) and tops[-1] < 844, "scene, status, pictures, switches"
    scene = page.locator("canvas").first.bounding_box()
    assert scene is not None and 200 < scene["height"] < 300
    visitor.close()


def test_a_sharp_screen_has_the_layout_of_its_width_and_is_drawn_sharply(browser, app: App):
    context = browser.new_context(viewport={"width": 1280, "height": 800}, device_scale_factor=2)
    page = context.new_page()
    page.goto(app.url)
    page.wait_for_selector(".mv-mosaic", timeout=PATIENCE)
    page.wait_for_function(f"() => ({SCENE})() < 0.9", timeout=PATIENCE)
    assert page.evaluate(SCENE) >= 0.4
    page.wait_for_function(
        """() => [...document.querySelectorAll('canvas')].some(
          one => one.width > 0 && Math.abs(one.width - 2 * one.clientWidth) < 3)""",
        timeout=PATIENCE,
    )
    assert page.evaluate("devicePixelRatio") == 2
    context.close()


def test_the_question_has_its_place_before_it_is_asked(browser, app: App):
    visitor = sized(browser, app, 1280, 800)
    page = visitor.page
    visitor.dismiss()
    tab = page.get_by_role("tab", name="What counts?")
    page.get_by_text("merged: their sum", exact=True).first.wait_for(timeout=PATIENCE)
    before = tab.bounding_box()
    visitor.press("1")  # An episode of 25 s: at the end of one, nobody is asked.
    visitor.press("again")
    visitor.press("off", camera=1)
    page.get_by_role("button", name="just show me").wait_for(timeout=PATIENCE)
    after = tab.bounding_box()
    assert before is not None and after is not None
    assert abs(after["y"] - before["y"]) <= 2
    visitor.close()
