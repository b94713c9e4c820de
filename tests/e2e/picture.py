"""Takes the pictures of docs/page.md, of the page as a visitor sees it:

python -m tests.e2e.picture

docs/page.png is the whole page, docs/panels/NAME.png one part of it each. Colours are reduced to
``COLOURS``, or the site would grow by megabytes.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import FloatRect, Page, sync_playwright

from madviz.app.server import ExploreConfig, open_app
from madviz.system.browser import CHROMIUM_FLAGS, find_browser

DOCS = Path(__file__).resolve().parents[2] / "docs"
WIDTH, HEIGHT = 1280, 800
LEFT, RIGHT = 443, 967
"""Where the left panel ends and the right one begins, in pixels."""
COLOURS = 255
TABS = {
    "What counts?": "features",
    "What if?": "subsets",
    "Sees what?": "inside",
    "Go back": "timeline",
    "More": "audit",
    "Failures": "failures",
    "Train": "train",
    "Save": "save",
}


def keep(page: Page, name: str, clip: FloatRect | None = None, wait: int = 1_500) -> None:
    """Writes what the page, or a part of it, shows after ``wait`` milliseconds."""
    page.mouse.move(800, 780)  # Or the hint of the last button would lie over the others.
    page.wait_for_timeout(wait)
    picture = Image.open(BytesIO(page.screenshot(clip=clip))).convert("RGB")
    file = DOCS / f"{name}.png"
    file.parent.mkdir(exist_ok=True)
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(file, optimize=True)
    print(file, f"{file.stat().st_size / 1000:.0f} kB")


def part(page: Page, selector: str, left: float, right: float, bottom: float = HEIGHT) -> FloatRect:
    """From the top of what is found down to ``bottom``."""
    box = page.locator(selector).first.bounding_box()
    assert box is not None
    return {"x": left, "y": box["y"], "width": right - left, "height": bottom - box["y"]}


def take(page: Page) -> None:
    """One camera dropped, another frozen, some steps into an episode; then a comparison."""
    page.wait_for_selector(".mv-status", timeout=60_000)
    keep(page, "panels/greeting", {"x": LEFT, "y": 0, "width": RIGHT - LEFT, "height": 290})
    page.get_by_role("button", name="explore one policy").click()
    page.wait_for_timeout(9_000)
    page.get_by_role("button", name="off", exact=True).nth(1).click()
    page.get_by_role("button", name="just show me").click()
    page.get_by_role("button", name="break …").nth(2).click()
    page.get_by_role("button", name="freeze").click()
    page.wait_for_timeout(2_500)
    tabs = page.get_by_role("tab", name="What counts?").bounding_box()
    assert tabs is not None
    keep(page, "panels/breaks", {"x": 0, "y": 228, "width": LEFT, "height": tabs["y"] - 228})
    page.get_by_role("button", name="close", exact=True).click()
    keep(page, "page")
    tabs = page.get_by_role("tab", name="What counts?").bounding_box()
    assert tabs is not None
    whole = {"x": 0.0, "y": 58.0, "width": float(LEFT), "height": tabs["y"] - 58}
    keep(page, "panels/cameras", whole)  # type: ignore[arg-type]
    keep(page, "panels/scene", {"x": LEFT, "y": 0, "width": RIGHT - LEFT, "height": HEIGHT})
    success = part(page, "text=Success at the last step", RIGHT, WIDTH)
    keep(page, "panels/success", success)
    keep(page, "panels/policy", {**success, "y": 55, "height": success["y"] - 55})
    below: FloatRect = {"x": 0, "y": tabs["y"], "width": LEFT, "height": HEIGHT - tabs["y"]}
    for name, file in TABS.items():
        page.get_by_role("tab", name=name).click()
        if file == "inside":
            page.get_by_role("button", name="for its Q").click()
            page.get_by_text("Bright: if this pixel").wait_for(timeout=60_000)
        keep(page, f"panels/{file}", below)
        if file == "inside":
            page.locator("[data-mv-grid=saliency] button").first.click()
    compare(page)


def compare(page: Page) -> None:
    """The third act of MAD against Merged Only, when both have ended."""
    page.get_by_role("button", name="compare", exact=True).click()
    for button in ("show me", "just show me", "next step"):
        page.get_by_role("button", name=button, exact=True).first.click()
        page.wait_for_timeout(2_000)
    ended = "() => [...document.querySelectorAll('.mv-side .tag')].some(e => e.innerText == 'FAIL')"
    page.wait_for_function(ended, timeout=120_000)
    picture: FloatRect = {"x": 0, "y": 58, "width": LEFT, "height": HEIGHT - 58}
    keep(page, "panels/comparison", picture, wait=0)


def draw(page: Page) -> None:
    """What MV-MAE draws of a camera that is dropped."""
    page.wait_for_selector(".mv-status", timeout=60_000)
    page.keyboard.press("Escape")
    page.wait_for_timeout(4_000)
    page.get_by_role("button", name="off", exact=True).nth(1).click()
    page.wait_for_timeout(2_500)
    tabs = page.get_by_role("tab", name="What counts?").bounding_box()
    assert tabs is not None
    keep(page, "panels/imagined", {"x": 0, "y": 58, "width": LEFT, "height": tabs["y"] - 58}, 0)


def imagine(page: Page) -> None:
    """What MV-MWM imagines of a camera that is dropped and of the next decisions."""
    page.wait_for_selector(".mv-status", timeout=60_000)
    page.keyboard.press("Escape")
    page.get_by_role("tab", name="Sees what?").click()
    page.get_by_role("button", name="off", exact=True).nth(2).click()
    page.get_by_role("button", name="next", exact=True).click()
    page.wait_for_timeout(300)
    page.get_by_role("button", name="imagine 15 decisions").click()
    page.get_by_text("Of 15 decisions 15 have been taken since").wait_for(timeout=60_000)
    box = page.locator(".mv-foresight").bounding_box()
    assert box is not None
    keep(page, "panels/foresight", {**box, "x": 0, "width": LEFT})


def photograph(config: ExploreConfig, height: int, take: Callable[[Page], None]) -> None:
    """Serves the page, opens it in a browser and calls ``take`` with it."""
    app = open_app(config)
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=str(find_browser()), args=list(CHROMIUM_FLAGS)
            )
            page = browser.new_page(viewport={"width": WIDTH, "height": height})
            page.goto(app.url)
            take(page)
            browser.close()
    finally:
        app.stop()


def main() -> None:
    photograph(ExploreConfig(port=8137, workers=1), HEIGHT, take)
    drawing = ExploreConfig(policy="metaworld-hammer-mv-mae-light", port=8139, workers=0)
    photograph(drawing, HEIGHT, draw)
    world_model = ExploreConfig(policy="toy-reach-mv-mwm-mv-mwm", port=8138, workers=0)
    photograph(world_model, 2 * HEIGHT, imagine)


if __name__ == "__main__":
    main()
