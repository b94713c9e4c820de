"""A headless Chromium: which one this machine has, and a page opened in it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from madviz.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Page

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM_FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
"""A browser without GPU and display, which sends nothing to anybody."""


def find_browser() -> str | None:
    """Path of the Chromium that tests and benchmarks drive; None where there is none."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def opened(url: str, chromium: str | None) -> Iterator[Page]:
    """A headless browser on ``url`` with the page ready. Raises UserError where there is none."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as error:
        raise UserError("bench live needs Playwright: pip install playwright") from error
    chromium = chromium or find_browser()
    if chromium is None:
        raise UserError("bench live needs a browser: apt-get install chromium")
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(
                executable_path=chromium, args=list(CHROMIUM_FLAGS)
            )
        except Error as error:
            raise UserError(f"{chromium} is not a browser that starts") from error
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(url)
        page.wait_for_selector(".mv-status", timeout=60_000)
        yield page
        browser.close()
