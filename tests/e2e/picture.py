"""Takes docs/page.png, the README's picture, of the page as a visitor sees it:

python -m tests.e2e.picture [WIDTH HEIGHT FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

from madviz.app.server import ExploreConfig, open_app
from madviz.system.browser import CHROMIUM_FLAGS, find_browser


def take(width: int, height: int, file: Path) -> None:
    """One camera dropped, another frozen, some steps into an episode."""
    app = open_app(ExploreConfig(port=8137, workers=1))
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=str(find_browser()), args=list(CHROMIUM_FLAGS)
            )
            page = browser.new_page(viewport={"width": width, "height": height})
            page.goto(app.url)
            page.wait_for_selector(".mv-status", timeout=60_000)
            page.wait_for_timeout(9_000)
            page.get_by_role("button", name="off").nth(1).click()
            page.get_by_role("button", name="freeze").nth(2).click()
            page.wait_for_timeout(2_500)
            for toast in page.locator("[role=alert] button").all():
                toast.click()
            page.mouse.move(800, 780)  # Or the hint of the last button would lie over the others.
            page.wait_for_timeout(1_500)
            file.parent.mkdir(exist_ok=True)
            page.screenshot(path=file)
            browser.close()
    finally:
        app.stop()


if __name__ == "__main__":
    words = sys.argv[1:] or ["1280", "800", "docs/page.png"]
    take(int(words[0]), int(words[1]), Path(words[2]))
