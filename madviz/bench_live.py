"""The page under a stop-watch: server, simulator, policy and a real browser on the same cores.

Everything is timed inside the browser, by its own clock: an *update* is a simulator step that was
not seen before and whose picture has been decoded, a *toggle* runs from the click on a button to
the moment when the picture shows that camera dropped (its tile has lost all colour) and the text of
the action has changed. The server is a process of its own, as a user would start it, at full speed.
"""

from __future__ import annotations

import random
import socket
import statistics
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from madviz.doctor import find_browser
from madviz.types import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Page

CHROMIUM_FLAGS = (
    *("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--no-first-run"),
)
"""A browser without a GPU, a display or a wish to talk to anybody."""

STOPWATCH = """
() => {
  const watch = window.madviz = {steps: [], pending: null, toggles: []};
  const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  const status = () => document.querySelector('.mv-status').dataset;
  const action = () => document.querySelector('.mv-action').innerText;
  // Mean distance of a tile's pixels from grey: a dropped camera's tile has none.
  const colour = (image, camera, cameras) => {
    canvas.canvas.width = 60; canvas.canvas.height = 20;
    canvas.drawImage(image, 0, 0, 60, 20);
    const wide = 60 / cameras;
    const pixels = canvas.getImageData(camera * wide + 2, 4, wide - 4, 14).data;
    let sum = 0;
    for (let i = 0; i < pixels.length; i += 4)
      sum += Math.max(pixels[i], pixels[i+1], pixels[i+2])
           - Math.min(pixels[i], pixels[i+1], pixels[i+2]);
    return sum / (pixels.length / 4);
  };
  document.addEventListener('load', event => {
    const image = event.target;
    if (image.className !== 'mv-mosaic') return;
    const now = performance.now(), seen = status(), p = watch.pending;
    watch.steps.push([now, image.dataset.step]);
    if (p === null || seen.setting === p.setting || action() === p.action) return;
    if ((colour(image, p.camera, p.cameras) < 6) !== p.off) return;
    watch.toggles.push(performance.now() - p.start);
    watch.pending = null;
  }, true);
  watch.toggle = (camera, off) => {
    const label = off ? 'off' : 'RGB';
    const buttons = [...document.querySelectorAll('button')].filter(b => b.innerText === label);
    watch.pending = {camera, cameras: buttons.length, off, setting: status().setting,
                     action: action(), start: performance.now()};
    buttons[camera].click();
  };
}
"""


@dataclass(frozen=True)
class LiveConfig:
    """Times the live page in a real browser, without and with evaluation workers."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    policy: str = "metaworld-hammer-mad-light"
    """A policy that takes RGB of several cameras."""
    seconds: float = 15.0
    """How long updates are counted."""
    toggles: int = 110
    """How many times a camera is switched off or on."""
    workers: int = 1
    """Evaluation workers of the second measurement."""
    chromium: str | None = None
    """The browser; by default the Chromium or Chrome of this machine."""


def bench_live(config: LiveConfig) -> dict[str, Any]:
    """Updates a second, milliseconds of toggles and of the readout; the same with workers."""
    if config.seconds <= 0 or config.toggles < 1:
        raise UserError("expected seconds above 0 and at least 1 toggle")
    alone = {**measure(config, workers=0), "readout_ms": readout_ms(config.policy)}
    busy = {**measure(config, workers=config.workers), "readout_ms": alone["readout_ms"]}
    return {"schema": 1, "policy": config.policy, **alone, "with_workers": busy}


def measure(config: LiveConfig, workers: int) -> dict[str, Any]:
    """One server, one browser: counts updates, then switches cameras off and on."""
    with served(config.policy, workers) as url, opened(url, config.chromium) as page:
        page.evaluate(STOPWATCH)
        page.wait_for_timeout(3000)
        updates = updates_per_s(page, config.seconds)
        raw = toggle_ms(page, config.toggles)
    ordered = sorted(raw)
    return {
        "updates_per_s": round(updates, 2),
        "toggle_ms_p50": round(statistics.median(ordered), 1),
        "toggle_ms_p95": round(ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))], 1),
        "toggle_ms": [round(value, 1) for value in raw],
    }


def updates_per_s(page: Page, seconds: float) -> float:
    """Distinct simulator steps whose pictures arrived, a second."""
    page.evaluate("madviz.steps = []; madviz.from = performance.now()")
    page.wait_for_timeout(1000 * seconds)
    steps, taken = page.evaluate("[madviz.steps, performance.now() - madviz.from]")
    return len({name for _, name in steps}) / (taken / 1000)


def toggle_ms(page: Page, count: int) -> list[float]:
    """Milliseconds from click to picture and text, at moments unrelated to steps."""
    rng = random.Random(0)
    off = [False, False, False]
    for number in range(count):
        camera = number % 3
        off[camera] = not off[camera]
        page.evaluate(f"madviz.toggle({camera}, {'true' if off[camera] else 'false'})")
        page.wait_for_function("madviz.pending === null", timeout=20_000, polling=20)
        page.wait_for_timeout(rng.uniform(100, 300))
    return page.evaluate("madviz.toggles")


def readout_ms(policy: str, repeats: int = 100) -> float:
    """Median milliseconds to read action and Q of every subset, features given."""
    import numpy as np

    from madviz.app.server import env_in_one_thread
    from madviz.checkpoint import load_policy
    from madviz.probes import probe
    from madviz.streams import IMAGE_SIZE

    loaded = load_policy(policy)
    env = env_in_one_thread(loaded.spec.task, loaded.spec.render_profile, loaded.spec.cameras)
    state = env.reset(seed=0).state
    shape = (len(loaded.spec.streams), 3 * loaded.spec.frame_stack, IMAGE_SIZE, IMAGE_SIZE)
    views = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    encoded, times = loaded.encode(views, state), []
    for _ in range(repeats):
        start = time.perf_counter()
        probe(loaded, encoded)
        times.append(1000 * (time.perf_counter() - start))
    env.close()
    return round(statistics.median(times), 3)


@contextmanager
def served(policy: str, workers: int) -> Iterator[str]:
    """``madviz explore`` in a process of its own; its address once it answers."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = ["explore", "--policy", policy, "--port", str(port), "--workers", str(workers)]
    process = subprocess.Popen(
        [sys.executable, "-m", "madviz", *words, "--speed", "None"], stdout=sys.stderr
    )
    url = f"http://127.0.0.1:{port}"
    try:
        await_answer(url, process)
        yield url
    finally:
        process.terminate()
        process.wait(20)


def await_answer(url: str, process: subprocess.Popen[bytes], patience: float = 60.0) -> None:
    """Returns when ``url`` answers. Raises UserError if the server ends or stays silent."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline and process.poll() is None:
        try:
            urllib.request.urlopen(url, timeout=1).close()
            return
        except (urllib.error.URLError, OSError):
            time.sleep(0.1)
    raise UserError("the page did not start; try: madviz explore")


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
