"""A page on the toy task, a real headless Chromium, and a picture of whatever went wrong."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright import sync_api as playwright_api

from madviz.app.access import Gate
from madviz.app.layout import Shared
from madviz.app.server import App
from madviz.app.success_rates import SuccessRates
from madviz.app.users import Limits
from madviz.envs.registry import make_env
from madviz.observation.ablation import CameraState
from madviz.session.commands import Play, Reset, SetCamera, SetPolicy, SetSpeed
from madviz.session.frame import Frame
from madviz.session.session import Session
from madviz.system.browser import CHROMIUM_FLAGS, find_browser
from madviz.training.job import TrainingJob
from tests.fakes import policies
from tests.pages import choices_of, seats, sessions_shown

PICTURES = Path(__file__).parents[2] / "build" / "e2e"
PATIENCE = 60_000
"""Milliseconds; a loaded machine is slow, and a failure may take its time."""
SHIPPED = {"all": {"success": 0.94, "n": 100}, "first": {"success": 0.81, "n": 100}}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.e2e)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item):
    report = (yield).get_result()
    browser = getattr(item, "funcargs", {}).get("browser")
    if report.when == "call" and report.failed and browser is not None:
        PICTURES.mkdir(parents=True, exist_ok=True)
        pages = [page for context in browser.contexts for page in context.pages]
        for number, page in enumerate(pages):
            page.screenshot(path=PICTURES / f"{item.name}-{number}.png")


@pytest.fixture(scope="package")  # Not longer: its event loop and threads are other tests' concern.
def browser() -> Iterator:
    chromium = find_browser()
    if chromium is None:  # Skipped browser tests would pass for a page that nobody has seen.
        pytest.fail("no browser found: apt-get install chromium")
    with playwright_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(CHROMIUM_FLAGS))
        yield browser
        browser.close()


@pytest.fixture(autouse=True)
def nothing_is_refused(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """A real page sends nothing for which the gate lets a visitor go."""
    yield
    said = [record.getMessage() for record in caplog.get_records("call")]
    assert not [line for line in said if line.startswith("let go of a connection")]


@pytest.fixture(scope="package")
def app() -> Iterator[App]:
    app = toy_app(visitors=4)
    yield app
    app.stop()


def toy_app(visitors: int, gate: Gate | None = None) -> App:
    """The page on the toy task with fake policies, on a free port."""
    names = ("toy-mad", "toy-other", "toy-rgbd", "toy-nan")
    rates = SuccessRates(lambda spec: SHIPPED if spec.name == "toy-mad" else {})
    training = TrainingJob(Path(tempfile.mkdtemp(prefix="madviz-runs-")))

    def new_session() -> Session:
        return Session(make_env, policies("toy-mad"), policies)

    shared = Shared(choices_of(*names), rates, training)
    return App(new_session, shared, Limits(visitors), gate=gate)


class Visitor:
    """One browser page, and what a person can see and do on it."""

    def __init__(self, page) -> None:
        self.page = page

    def status(self, name: str) -> str:
        return self.page.locator(".mv-status").get_attribute(f"data-{name}")

    def until(self, condition: str) -> None:
        """Waits for a JavaScript condition; ``status`` is what the episode's card says."""
        status = "const status = document.querySelector('.mv-status')?.dataset ?? {};"
        self.page.wait_for_function(f"() => {{ {status} return {condition} }}", timeout=PATIENCE)

    def until_text(self, selector: str, pattern: str, patience: float = PATIENCE) -> str:
        """Waits for text that matches, some milliseconds at most; returns it."""
        quoted = pattern.replace("'", "\\'")
        self.page.wait_for_function(
            f"() => new RegExp('{quoted}').test(document.querySelector('{selector}')?.innerText)",
            timeout=patience,
        )
        return self.page.locator(selector).inner_text()

    def press(self, label: str, camera: int = 0) -> None:
        """Clicks a button; those that every camera has are told apart by its position."""
        pattern = re.compile(f"^{re.escape(label)}$")
        self.page.get_by_role("button", name=pattern).nth(camera).click()

    def breaks(self, how: str, camera: int) -> None:
        """Opens what breaks a camera, unless it is open, and presses a button there."""
        opened = self.page.locator("[data-mv-grid=breaks]")
        if not opened.count():
            self.press("break …", camera)
        self.press(how)

    def close_breaks(self) -> None:
        """Closes what breaks a camera, where it is open, and waits until it is gone."""
        close = self.page.get_by_role("button", name="close", exact=True)
        if close.count():
            close.click()
            close.wait_for(state="detached", timeout=PATIENCE)

    def pick(self, policy: str) -> None:
        """Chooses a policy from the list."""
        name = self.page.locator("label", has_text="Policy").get_attribute("for")
        self.page.locator(f'[id="{name}"]').click()
        self.page.get_by_role("option", name=policy, exact=True).click()

    def dismiss(self) -> None:
        """Closes the notices that lie over the scene, viser's own among them."""
        self.page.wait_for_function(
            """() => {
              const notices = [...document.querySelectorAll('.mantine-Notification-root')];
              notices.forEach(one => one.querySelector('button')?.click());
              return !notices.length;
            }""",  # Some go by themselves, also while they are about to be clicked.
            timeout=PATIENCE,
        )

    def tile(self, camera: int) -> list[list[int]]:
        """The RGB pixels of one camera's tile, as the browser shows it, 20 rows of 20."""
        return self.page.evaluate(
            """camera => {
              const image = document.querySelector('.mv-mosaic');
              const size = image.naturalWidth / 3, top = image.naturalHeight - size + 8;
              const canvas = document.createElement('canvas').getContext('2d');
              canvas.canvas.width = canvas.canvas.height = 20;
              canvas.drawImage(image, camera * size + 4, top, size - 8, size - 8, 0, 0, 20, 20);
              const data = canvas.getImageData(0, 0, 20, 20).data;
              return [...Array(400).keys()].map(i => [...data.slice(4 * i, 4 * i + 3)]);
            }""",
            camera,
        )

    def close(self) -> None:
        if not self.page.is_closed():
            self.page.context.close()


def arrive(browser, url: str) -> Visitor:
    """A new visitor at 1280x800, whose page has nothing on it yet."""
    page = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
    page.goto(url + ("&" if "?" in url else "?") + "fixedDpr=0.25")  # Less to draw in software.
    return Visitor(page)


def open_page(browser, url: str) -> Visitor:
    """A new visitor, once their page shows an episode."""
    visitor = arrive(browser, url)
    visitor.page.wait_for_selector(".mv-status", timeout=PATIENCE)
    return visitor


@pytest.fixture(scope="package")
def long_visit(browser, app: App) -> Visitor:
    """One page for all tests that can share it: opening one takes seconds."""
    return open_page(browser, app.url)


@pytest.fixture
def visitor(long_visit: Visitor, app: App) -> Visitor:
    """The shared page, as if it had just been opened."""
    wait_until(lambda: seats(app.users)[0] == 1)
    (session,) = sessions_shown(app.users).values()
    latest = session.latest
    assert isinstance(latest, Frame)
    for command in (SetPolicy("toy-mad"), SetSpeed(10.0), Reset(), Play()):
        session.send(command)
    for camera in latest.world.env.cameras:
        session.send(SetCamera(camera.name, CameraState("rgb")))
    long_visit.close_breaks()
    long_visit.page.get_by_role("tab", name="What counts?").click()
    long_visit.until("status.setting === 'all' && status.phase === 'playing'")
    return long_visit


@pytest.fixture
def visit(browser) -> Iterator[Callable[[str], Visitor]]:
    """Opens further pages, and closes them when the test is over."""
    opened: list[Visitor] = []

    def visit(url: str) -> Visitor:
        opened.append(open_page(browser, url))
        return opened[-1]

    yield visit
    for one in opened:
        one.close()


def wait_until(condition, seconds: float = PATIENCE / 1000) -> None:
    """Polls the server's own state; for what a browser cannot see."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)
