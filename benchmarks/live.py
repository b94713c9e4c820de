"""Times the page: server, simulator, policy and a real browser on the same cores.

Everything is timed inside the browser, by its own clock: an *update* is a simulator step that was
not seen before and whose picture has been decoded, a *toggle* runs from the click on a button to
the moment when the picture shows that camera dropped (its tile has lost all colour, or has the
frame around what is imagined) and the text of the action has changed. The server is a process of
its own, as a user would start it, at full speed.

What watchers get is timed by visitors without browsers (``visitor.py``): real watchers use
machines of their own, and four browsers on two cores would time each other.

    updates_per_s, toggle_ms_p50, toggle_ms_p95, toggle_ms   one browser, scene and curves on
    updates_per_s_dropped                                    without the first camera
    readout_ms                                               action and Q of every subset
    watchers: {count, updates_per_s, least, owner}           of one simulation, without workers
    with_workers: {updates_per_s, ...}                       the browser again, beside evaluations
    with_training: {updates_per_s, ...}                      the browser again, beside a training
"""

from __future__ import annotations

import random
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.page_server import serving
from madviz.errors import UserError
from madviz.policies.checkpoint import PolicyName
from madviz.system.browser import CHROMIUM_FLAGS, find_browser
from madviz.system.numbers import Count, CountOrNone, ThreadsOrNone, Time

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

STOPWATCH = files("benchmarks").joinpath("stopwatch.js")
"""Runs in the page and takes the times."""


@dataclass(frozen=True)
class LiveConfig:
    """Times the live page in a real browser, without and with evaluation workers."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    policy: PolicyName = "metaworld-hammer-mad-light"
    """A policy that takes RGB of several cameras."""
    seconds: Time = 15.0
    """How long updates are counted."""
    toggles: Count = 110
    """How many times a camera is switched off or on."""
    workers: ThreadsOrNone = 1
    """Evaluation workers of the second measurement; 0 leaves it out."""
    scene: bool = True
    """Draw the 3D scene at full resolution; without it, the browser hardly draws it at all."""
    watchers: CountOrNone = 0
    """How many watch one simulation in a measurement of their own; 0 leaves it out."""
    training: bool = False
    """Measure once more beside a training, as the page's Train tab starts one."""
    chromium: str | None = None
    """The browser; by default the Chromium or Chrome of this machine."""


def bench_live(config: LiveConfig) -> dict[str, Any]:
    """Updates a second, milliseconds of toggles and of the readout; the same with workers, and what
    watchers get."""
    alone = {**measure(config, workers=0), "readout_ms": readout_ms(config.policy)}
    result = {"schema": 1, "policy": config.policy, "scene": config.scene, **alone}
    if config.watchers:
        result["watchers"] = watched(config)
    if config.workers:
        busy = measure(config, workers=config.workers)
        result["with_workers"] = {**busy, "readout_ms": alone["readout_ms"]}
    if config.training:
        result["with_training"] = beside_training(config)
    return result


def watched(config: LiveConfig) -> dict[str, Any]:
    """One simulation, its owner and those who watch: what the server sends each of them a second,
    all at once."""
    from benchmarks.visitor import Visitor

    words = ["--visitors", "1", "--watchers", str(config.watchers)]
    with serving(options(config, workers=0) + words) as (url, _), ExitStack() as stack:
        people: list[Visitor] = []
        for _ in range(1 + config.watchers):
            people.append(stack.enter_context(Visitor(url)))
            if not await_that(lambda: people[-1].steps, 60.0):
                raise UserError("the page sent no picture; try: madviz explore")
        time.sleep(3.0)
        with ThreadPoolExecutor(len(people)) as pool:
            rates = list(pool.map(lambda one: one.updates_per_s(config.seconds), people))
    owner, *watchers = [round(rate, 2) for rate in rates]
    return {
        "count": config.watchers,
        "updates_per_s": watchers,
        "least": min(watchers),
        "owner": owner,
    }


def beside_training(config: LiveConfig) -> dict[str, Any]:
    """The browser again, while its policy's task is trained at the priority that the page gives to
    trainings. Raises UserError if the training does not last as long as the measurement."""
    from madviz.policies.checkpoint import load_policy
    from madviz.training.job import OFFERS, JobConfig, TrainingJob

    task = load_policy(config.policy).spec.task
    with tempfile.TemporaryDirectory() as folder:
        job = TrainingJob(Path(folder))
        try:
            job.start(JobConfig(task, budget=list(OFFERS["light"].budgets)[-1]))
            # Demonstrations come first, and updates are what takes the time.
            await_that(lambda: job.status().rows or job.status().state != "running", 300.0)
            if not job.status().rows:
                raise UserError(
                    "expected a training to begin within 5 minutes, found no round of it"
                )
            found = measure(config, workers=0)
            status = job.status()
        finally:
            job.close()
    if status.state != "running":
        raise UserError(f"expected a training to last, found it {status.state}: {status.why}")
    return found


def await_that(happened: Callable[[], object], patience: float) -> bool:
    """Whether it happened within ``patience`` seconds."""
    deadline = time.monotonic() + patience
    while not happened():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def measure(config: LiveConfig, workers: int) -> dict[str, Any]:
    """One server, one browser: counts updates, with all cameras and without the first (which some
    policies imagine then), and switches cameras off and on."""
    address = "" if config.scene else "/?fixedDpr=0.05"
    with (
        serving(options(config, workers)) as (url, _),
        opened(url + address, config.chromium) as page,
    ):
        page.evaluate(STOPWATCH.read_text())
        page.wait_for_timeout(3000)
        updates = updates_per_s(page, config.seconds)
        switch(page, camera=0, off=True)
        dropped = updates_per_s(page, config.seconds)
        switch(page, camera=0, off=False)
        page.evaluate("madviz.toggles = []")
        raw = toggle_ms(page, config.toggles)
    ordered = sorted(raw)
    return {
        "updates_per_s": round(updates, 2),
        "updates_per_s_dropped": round(dropped, 2),
        "toggle_ms_p50": round(statistics.median(ordered), 1),
        "toggle_ms_p95": round(ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))], 1),
        "toggle_ms": [round(value, 1) for value in raw],
    }


def options(config: LiveConfig, workers: int) -> list[str]:
    """The options of ``madviz explore`` at full speed."""
    return ["--policy", config.policy, "--workers", str(workers), "--speed", "None"]


def updates_per_s(page: Page, seconds: float) -> float:
    """Distinct simulator steps whose pictures arrived, a second."""
    page.evaluate("madviz.steps = []; madviz.from = performance.now()")
    page.wait_for_timeout(1000 * seconds)
    steps, taken = page.evaluate("[madviz.steps, performance.now() - madviz.from]")
    return len({name for _, name in steps}) / (taken / 1000)


def switch(page: Page, camera: int, off: bool) -> None:
    """Clicks, and waits for the picture and the text that show it."""
    page.evaluate(f"madviz.toggle({camera}, {'true' if off else 'false'})")
    page.wait_for_function("madviz.pending === null", timeout=20_000, polling=20)


def toggle_ms(page: Page, count: int) -> list[float]:
    """Milliseconds from click to picture and text, at moments unrelated to steps."""
    rng = random.Random(0)
    off = [False, False, False]
    for number in range(count):
        camera = number % 3
        off[camera] = not off[camera]
        switch(page, camera, off[camera])
        page.wait_for_timeout(rng.uniform(100, 300))
    return page.evaluate("madviz.toggles")


def readout_ms(policy: str, repeats: int = 100) -> float:
    """Median milliseconds to read action and Q of every subset, features given."""
    import numpy as np

    from madviz.analysis.probes import probe
    from madviz.app.session_maker import env_in_one_thread
    from madviz.observation.streams import IMAGE_SIZE
    from madviz.policies.checkpoint import load_policy

    loaded = load_policy(policy)
    env = env_in_one_thread(loaded.spec.task, loaded.spec.render_profile, loaded.spec.cameras)
    state = env.reset(seed=0).state
    shape = (len(loaded.spec.streams), 3 * loaded.spec.frame_stack, IMAGE_SIZE, IMAGE_SIZE)
    views = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    encoded = loaded.encode(views, state)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        probe(loaded, encoded)
        times.append(1000 * (time.perf_counter() - start))
    env.close()
    return round(statistics.median(times), 3)


@contextmanager
def opened(url: str, chromium: str | None) -> Iterator[Page]:
    """A headless browser on ``url`` with the page ready. Raises UserError where there is none."""
    with started(chromium, CHROMIUM_FLAGS) as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(url)
        page.wait_for_selector(".mv-status", timeout=60_000)
        yield page


@contextmanager
def started(chromium: str | None, flags: Sequence[str]) -> Iterator[Browser]:
    """A headless browser. Raises UserError where there is none."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as error:
        raise UserError("this benchmark needs Playwright: pip install playwright") from error
    chromium = chromium or find_browser()
    if chromium is None:
        raise UserError("this benchmark needs a browser: apt-get install chromium")
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=chromium, args=list(flags))
        except Error as error:
            raise UserError(f"{chromium} is not a browser that starts") from error
        yield browser
        browser.close()
