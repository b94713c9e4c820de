"""Notebooks in a real JupyterLab in a real Chromium: all cells run, a switch is clicked, and the
live page is there behind the notebook server's proxy.

The policies are fakes on the toy task, so that a loaded machine gets there; the notebooks are the
ones that ship, with another policy's name in them.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import nbformat
import pytest

from tests.e2e.conftest import PICTURES
from tests.e2e.jupyterlab import ERRORS, PANEL, READY, RUN

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 240_000
"""Milliseconds. A kernel imports PyTorch before the first cell is done, on a machine that also runs
the browser, the notebook server and other tests."""
FAKE = "tests.fakes:FakePolicy"
ALL_RAN = f"""() => [...({PANEL})().content.model.cells]
  .filter(cell => cell.type === 'code').every(cell => cell.executionCount !== null)"""
COUNT_PICTURES = """async milliseconds => {
  const image = document.querySelector('.jp-OutputArea img.widget-image');
  let count = 0;
  const watch = new MutationObserver(() => { count += 1; });
  watch.observe(image, {attributes: true, attributeFilter: ['src']});
  const began = performance.now();
  await new Promise(resolve => setTimeout(resolve, milliseconds));
  watch.disconnect();
  return 1000 * count / (performance.now() - began);
}"""
"""How often the one image element gets another picture, a second."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def prepare(folder: Path, name: str) -> None:
    """A copy of a notebook without outputs, whose policies are fakes."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", 4)
    notebook.metadata.pop("widgets", None)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
            cell.source = re.sub(r"load_policy\(\S+?\)", f'load_policy("{FAKE}")', cell.source)
            cell.source = cell.source.replace("live_page(POLICY)", f'live_page("{FAKE}")')
    nbformat.write(notebook, folder / f"{name}.ipynb")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A JupyterLab of its own, under a path as on a class server; its address."""
    folder, port = tmp_path_factory.mktemp("lab"), free_port()
    for name in ("02_merge", "09_live_page"):
        prepare(folder, name)
    home = folder / "home"
    environment = {
        **{key: value for key, value in os.environ.items() if not key.startswith("JUPYTER")},
        "PYTHONPATH": str(ROOT),
        "JUPYTER_CONFIG_DIR": str(home / "config"),
        "JUPYTER_DATA_DIR": str(home / "data"),
        "JUPYTER_RUNTIME_DIR": str(home / "run"),
    }
    words = [sys.executable, "-m", "jupyter", "lab", "--no-browser", "--allow-root"]
    words += ["--ServerApp.ip=127.0.0.1", f"--ServerApp.port={port}", "--ServerApp.port_retries=0"]
    words += ["--IdentityProvider.token=", "--ServerApp.base_url=/class/"]
    words += ["--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate"]
    words += ["--LabApp.expose_app_in_browser=True", "--ServerApp.root_dir=" + str(folder)]
    log = (folder / "lab.log").open("w")
    server = subprocess.Popen(words, env=environment, stdout=log, stderr=log, cwd=folder)
    try:
        yield wait_for(f"http://127.0.0.1:{port}/class/", server, folder / "lab.log")
    finally:
        server.terminate()
        server.wait(60)
        log.close()
        shutil.rmtree(home, ignore_errors=True)


def wait_for(url: str, server: subprocess.Popen, log: Path) -> str:
    deadline = time.monotonic() + PATIENCE / 1000
    while time.monotonic() < deadline:
        assert server.poll() is None, log.read_text()
        try:
            if urllib.request.urlopen(url + "api/status", timeout=5).status == 200:
                return url
        except OSError:
            time.sleep(0.2)
    raise AssertionError(log.read_text())


def run_all(browser, lab: str, name: str, asked: set[str]):
    """Opens a notebook at 1280x1000, runs all of it, and waits until every cell is done. Machines
    that were asked for anything are in ``asked``."""
    page = browser.new_context(viewport={"width": 1280, "height": 1000}).new_page()
    page.set_default_timeout(PATIENCE)
    page.on("request", lambda request: asked.add(urlsplit(request.url).netloc))
    page.goto(f"{lab}lab/tree/{name}.ipynb?reset")
    page.wait_for_selector(".jp-NotebookPanel .jp-Cell")
    page.wait_for_function(READY)
    page.evaluate(RUN)
    page.wait_for_function(ALL_RAN)
    return page


def elsewhere(asked: set[str], lab: str) -> set[str]:
    """Machines other than the notebook's own server; a class may have no network."""
    return asked - {urlsplit(lab).netloc, ""}


def errors(page) -> list[str]:
    """What cells complained about."""
    return [error["evalue"] for error in page.evaluate(ERRORS)]


def picture(page, name: str) -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=PICTURES / f"{name}.png")


def test_a_lesson_runs_and_a_click_takes_a_camera_away(browser, lab: str) -> None:
    asked: set[str] = set()
    page = run_all(browser, lab, "02_merge", asked)
    try:
        assert errors(page) == []
        image = page.locator(".jp-OutputArea img.widget-image")
        image.scroll_into_view_if_needed()
        page.wait_for_function(
            "() => document.querySelector('.jp-OutputArea img.widget-image')?.naturalWidth > 600"
        )
        page.get_by_role("button", name="off", exact=True).nth(1).click()
        page.get_by_text("Third A dropped: action changed by").wait_for()
        page.get_by_role("cell", name="First person + Third B").last.wait_for()
        page.locator("select").filter(has_text="as fast as it goes").select_option(
            label="as fast as it goes"
        )
        page.get_by_role("button", name="Play", exact=True).click()
        page.get_by_role("button", name="Pause", exact=True).wait_for()
        rate = page.evaluate(COUNT_PICTURES, 5000)
        print(f"{rate:.1f} pictures a second")
        assert rate > 2, "on whatever machine; README.md says what an idle one does"
        picture(page, "notebook-explorer")
        assert elsewhere(asked, lab) == set()
    finally:
        page.context.close()


def test_the_live_page_is_there_behind_the_proxy(browser, lab: str) -> None:
    asked: set[str] = set()
    page = run_all(browser, lab, "09_live_page", asked)
    try:
        assert errors(page) == []
        frame = page.locator("iframe.madviz-page")
        frame.scroll_into_view_if_needed()
        address = frame.get_attribute("src")
        assert address and re.fullmatch(r"/class/proxy/\d+/", address)
        inside = page.frame_locator("iframe.madviz-page")
        inside.locator(".mv-status").wait_for(state="attached")
        inside.locator(".mv-mosaic").wait_for()
        picture(page, "notebook-live-page")
        assert elsewhere(asked, lab) == set()
    finally:
        page.context.close()
