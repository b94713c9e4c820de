"""Recordings on the static site: what plays them, and what happens where a file is cut off."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.static_site import MAD, NO_WEBGL, fake_site, served, toy_recording, until


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A site with recordings of toy/reach alone; one of its files is cut off."""
    folder = fake_site(tmp_path_factory.mktemp("site") / "below")
    line = toy_recording(folder)
    cut = folder / "recordings" / "none.gz"
    cut.write_bytes(cut.read_bytes()[:2000])
    return fake_site(folder, recordings=[line])


@pytest.fixture
def page(browser, folder: Path) -> Iterator[Any]:
    """The recording, in a browser that cannot simulate."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = context.new_page()
    page.set_default_timeout(30_000)
    page.add_init_script(NO_WEBGL)
    with served(folder) as url:
        page.goto(f"{url}#policy=toy-mad")
        page.wait_for_selector("body[data-ready]")
        yield page
        context.close()


def test_a_link_that_no_recording_can_obey_is_said(page) -> None:
    link = "#policy=toy-mad&first=black@2&third_a=move:0:0:0:5:0:1&third_b=off@1&guard=on"
    page.evaluate("link => { location.hash = link; }", link)
    until(page, "Moved and broken cameras and the guard are left out.", "#notices")
    page.wait_for_function("() => /third_b=off@1$/.test(location.hash)")


def picture(page: Any) -> str:
    return page.evaluate("() => document.querySelector('.view canvas').toDataURL()")


def test_a_browser_that_cannot_simulate_plays_recordings(page) -> None:
    assert "What follows are recorded episodes" in until(page, "WebGL2", "#notices")
    assert "A recording" in until(page, "CC BY-NC", ".side .about")
    until(page, "recorded", ".scene .hint")
    first = picture(page)
    page.wait_for_function(
        "before => document.querySelector('.view canvas').toDataURL() !== before", arg=first
    )
    page.locator("#headline").click()
    page.keyboard.press("2")
    page.wait_for_function("() => document.querySelector('.view[data-camera=third_a].off')")
    until(page, "First + Third_B", "table.success tr.current")
    assert page.get_by_role("button", name="Run 20").count() == 0


def test_the_simulation_waits_while_a_recording_plays(browser, folder: Path) -> None:
    """It has the episodes that *Save* writes."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.set_default_timeout(30_000)
    workers: list[str] = []
    page.on("worker", lambda worker: workers.append(worker.url))
    with served(folder) as url:
        page.goto(f"{url}#policy={MAD}")
        until(page, "MAD: Hammer", "#headline")
        page.evaluate("() => { location.hash = '#policy=toy-mad'; }")
        assert "A recording" in until(page, "CC BY-NC", ".side .about")
        page.evaluate(f"() => {{ location.hash = '#policy={MAD}&third_a=off'; }}")
        until(page, "MAD: Hammer", "#headline")
        page.wait_for_selector(".view[data-camera=third_a].off")
        assert len([one for one in workers if one.endswith("worker.js")]) == 1
        page.close()


def test_the_first_scene_is_live_whatever_was_played_before(browser, folder: Path) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.set_default_timeout(30_000)
    with served(folder) as url:
        page.goto(f"{url}#policy=toy-mad")
        assert "A recording" in until(page, "CC BY-NC", ".side .about")
        page.get_by_role("button", name="Show me first").click()
        page.wait_for_selector("body[data-mode=opening]")
        page.wait_for_function("() => document.querySelectorAll('.side').length === 2")
        assert "A recording" not in page.locator("#stage").inner_text()
    page.close()


def test_a_recording_that_is_cut_off_gets_a_sentence_and_the_page_lives(page) -> None:
    page.locator("#headline").click()
    for key in "123":
        page.keyboard.press(key)
    until(page, "the file is cut off or damaged", "#notices")
    page.keyboard.press("1")
    until(page, "First", "table.success tr.current")
    before = picture(page)
    page.get_by_role("button", name="Again", exact=True).click()
    page.wait_for_function(
        "before => document.querySelector('.view canvas').toDataURL() !== before", arg=before
    )
