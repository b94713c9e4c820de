"""The static site as a visitor gets it: its own worker, a real Chromium, and hammer."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from madviz.session.replay import finder, replay_row
from madviz.session.session_reader import parse
from madviz.site.site import SiteConfig, run_site
from tests.e2e.static_site import MAD, MERGED_ONLY, served, until

PATIENCE = 240_000
"""Milliseconds; an episode of a hundred decisions on a loaded machine."""
EVERY = 40
LOSING = f"""() => {{
  const {{readPixels}} = WebGL2RenderingContext.prototype;
  let calls = 0;
  WebGL2RenderingContext.prototype.readPixels = function (...words) {{
    if (++calls % {EVERY} === 3) {{
      const driver = this.getExtension('WEBGL_lose_context');
      driver.loseContext();
      setTimeout(() => driver.restoreContext(), 300);
      self.lost = (self.lost ?? 0) + 1;
    }}
    return readPixels.apply(this, words);
  }};
}}"""
"""In the worker: the driver takes the context away while pictures are drawn, and gives it back."""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Of the site in a folder below the host's root."""
    folder = tmp_path_factory.mktemp("site")
    out = folder / "below"
    run_site(SiteConfig(str(out), (MAD, MERGED_ONLY), seeds="5000:5002", recorded=0))
    with served(folder) as url:
        yield f"{url}below/"


@pytest.fixture
def page(browser) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = context.new_page()
    page.set_default_timeout(PATIENCE)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    yield page
    context.close()
    assert errors == []


def test_a_camera_goes_black_and_with_the_guard_one_of_two_policies_succeeds(page, address) -> None:
    asked: list[str] = []
    page.context.on("request", lambda request: asked.append(request.url))
    page.goto(address)
    until(page, "MAD and Merged Only both drove the nail in.", "#line")
    page.get_by_role("button", name="Next: First person goes black").click()
    until(page, "Which policy will still do it?", "#line")
    page.get_by_role("button", name="Just show me").click()
    until(page, "Step 15: First person sends black.", "#line")
    until(page, "First person sent black from step 15.", "#line")
    page.get_by_role("button", name="Next: the same with the guard").click()
    until(page, "Guard: First person sends black since step 15", "#line")
    until(page, "MAD drove the nail in, Merged Only did not.", "#line")
    assert any("runtime/mujoco.wasm" in url for url in asked), "the worker's requests count, too"
    others = [
        url for url in asked if not url.startswith((address, "data:", f"blob:{origin(address)}"))
    ]
    assert others == []
    # Turning the scene with keys shows another picture of it.
    picture = "() => document.querySelector('.scene canvas').toDataURL()"
    before = page.evaluate(picture)
    page.locator(".scene canvas").first.press("ArrowLeft")
    page.wait_for_function(f"before => ({picture})() !== before", arg=before)


STROKES = """
const {drawImage, stroke} = CanvasRenderingContext2D.prototype;
Object.assign(CanvasRenderingContext2D.prototype, {
  drawImage(...what) { this.canvas.lines = []; return drawImage.apply(this, what); },
  stroke(...what) { this.canvas.lines?.push(this.strokeStyle); return stroke.apply(this, what); },
});
"""
"""Runs in a page before its own scripts: a canvas keeps the colours of lines over its picture."""
PATHS = """() => ['#ffd166', '#ffffff'].map(
  colour => document.querySelector('.scene canvas').lines.includes(colour)).join()"""
"""True for the hand's path, and for its path with all cameras, where the scene has it."""


def test_an_episode_ends_with_the_hands_path_beside_the_one_with_all_cameras(page, address) -> None:
    page.add_init_script(STROKES)
    page.goto(f"{address}#policy={MERGED_ONLY}&seed=5001&first=off@15")
    page.wait_for_selector("body[data-ready]")
    page.locator("#speed").select_option("")
    until(page, "Merged Only did not drive the nail in.", "#line")
    assert page.evaluate(PATHS) == "false,false", "known before it was played once more"
    until(page, " cm from its path with all cameras, and 1 cm for the first time at step", "#line")
    said = page.locator("#line").inner_text()
    assert float(re.findall(r"up to ([0-9.]+) cm from its path", said)[0]) > 1
    page.wait_for_function(f"() => ({PATHS})() === 'true,true'")
    page.get_by_role("button", name="Again", exact=True).click()
    page.wait_for_function("() => !document.querySelector('#line').innerText.includes(' cm ')")
    page.wait_for_function(f"() => ({PATHS})() === 'false,false'")


def origin(address: str) -> str:
    return "/".join(address.split("/")[:3])


def test_a_link_is_played_saved_and_played_by_python(page, address, tmp_path: Path) -> None:
    page.goto(f"{address}#policy={MAD}&seed=5001&third_a=off@5&first=noise:0.5@10-20")
    page.wait_for_selector("body[data-ready]")
    page.locator("#speed").select_option("")
    page.wait_for_function(
        "() => /success|failed/.test(document.querySelector('.outcome').innerText)"
    )
    page.wait_for_function("() => location.hash.includes('first=on@20')")
    link = page.url
    assert "third_a=off@5" in link and "first=noise:0.5@10" in link and "seed=5001" in link
    with page.expect_download() as download:
        page.get_by_role("button", name="Save", exact=True).click()
    path = Path(download.value.path())
    (episode,) = (saved := parse(path.read_bytes(), "the site's file")).episodes
    assert (episode.seed, episode.steps, episode.ended) == (5001, 100, True)
    row = replay_row(episode, saved, finder())
    assert row["success"] == row["success_here"] and row["same"]
    session = tmp_path / "session.json"
    session.write_bytes(path.read_bytes())
    page.locator("input[type=file]").set_input_files(session)
    page.wait_for_function("() => document.querySelector('.outcome').innerText === 'working'")
    page.wait_for_function("() => location.hash.includes('first=on@20')")
    assert sorted(page.url.split("&")) == sorted(link.split("&"))


def played(page) -> dict[str, Any]:
    """The episode that a link plays, as it is saved."""
    page.locator("#speed").select_option("")
    page.wait_for_function(
        "() => /success|failed/.test(document.querySelector('.outcome').innerText)"
    )
    with page.expect_download() as download:
        page.get_by_role("button", name="Save", exact=True).click()
    return json.loads(Path(download.value.path()).read_text())["episodes"][-1]


def test_a_driver_that_takes_pictures_away_changes_no_action(page, address) -> None:
    link = f"{address}#policy={MAD}&seed=5001&first=off@30"
    page.goto(link)
    page.wait_for_selector("body[data-ready]")
    (worker,) = page.workers
    worker.evaluate(LOSING)
    disturbed = played(page)
    assert worker.evaluate("self.lost") >= disturbed["steps"] // EVERY
    until(page, "The graphics driver took the pictures away.")
    page.goto("about:blank")
    page.goto(link)
    page.wait_for_selector("body[data-ready]")
    assert played(page) == disturbed, "the digests of all actions too"


def test_a_hidden_page_stands_still_and_goes_on(page, address) -> None:
    page.goto(f"{address}#policy={MAD}&seed=5000")
    page.wait_for_selector("body[data-ready]")
    now = page.locator(".now")
    hide = """hidden => {
      Object.defineProperty(document, 'hidden', {value: hidden, configurable: true});
      document.dispatchEvent(new Event('visibilitychange'));
    }"""
    until(page, " · step ", ".now")
    page.evaluate(hide, True)
    page.wait_for_timeout(1000)  # What was under way is shown.
    before = now.inner_text()
    page.wait_for_timeout(2000)
    assert now.inner_text() == before
    page.evaluate(hide, False)
    page.wait_for_function(
        "before => document.querySelector('.now').innerText !== before", arg=before
    )
