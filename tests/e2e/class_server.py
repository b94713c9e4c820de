"""A class at a class server: students log in with real browsers at once, run lessons, open pages.

    sudo .venv/bin/python -m tests.e2e.class_server --prefix /opt/madviz-class --json FILE

Not a test of the suite: it needs root, an installation by tools/class_server/server.py, minutes.
It makes accounts mvclass01, … on this machine and removes them at its end. Everything is as a class
has it: real accounts, their passwords, the proxy, JupyterLab. Browsers run on the same cores.

What it writes, of each student: seconds until a notebook is open and its kernel answers, until
another kernel of it answers (the browser has nothing to load then), and until its cells are done;
the largest memory in MB, proportional (PSS), looked at twice a second: of a kernel with its worker
processes, of the page, and of all processes of the student. What failed for a student is in
``failed``; the others go on, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import os
import pwd
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import defaultdict
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from playwright.async_api import BrowserContext, Page, async_playwright
from playwright.async_api import TimeoutError as PlaywrightTimeoutError

from benchmarks.memory import proportional_megabytes
from madviz.system.browser import CHROMIUM_FLAGS, find_browser
from madviz.system.files import pretty, write_json
from tests.e2e.jupyterlab import ERRORS, PANEL, READY, RUN

ROOT = Path(__file__).resolve().parents[2]
SERVER = ROOT / "tools" / "class_server" / "server.py"
PATIENCE = 240_000
PAGE_PATIENCE = 600_000
"""Milliseconds. Browsers draw the scenes of four pages on the cores that serve them."""
PAGE_SECONDS = 15.0
COARSE = "?fixedDpr=0.05"
"""Of a page's address: its 3D scene is hardly drawn. A class draws it on laptops; here browsers
without a GPU would draw four of them on the cores that are measured."""
LIGHT = ("--disable-gpu-rasterization", "--disable-gpu-compositing")
"""A computed GPU draws letters and boxes far slower than the browser does without one."""
PICTURES = ROOT / "build" / "e2e"
EXPOSED = "c = get_config()\nc.LabApp.expose_app_in_browser = True\n"
STATE = f"""() => {{
  const shell = window.jupyterapp?.shell, panel = ({PANEL})();
  const kernel = panel?.sessionContext.session?.kernel;
  return {{
    address: location.href, focus: document.hasFocus(),
    main: shell ? [...shell.widgets('main')].map(widget => widget.title.label) : 'no shell',
    current: shell?.currentWidget?.title.label ?? null,
    ready: panel?.context.isReady ?? null,
    kernel: kernel ? `${{kernel.connectionStatus}}, ${{kernel.status}}` : null,
    dialogs: [...document.querySelectorAll('.jp-Dialog-content')].map(one => one.innerText),
  }};
}}"""
"""What is looked at where a notebook does not become ready."""
ANSWERS = f"""async () => {{
  await ({PANEL})().sessionContext.session.kernel.requestExecute({{code: ''}}).done;
}}"""
RESTART = f"async () => {{ await ({PANEL})().sessionContext.restartKernel(); }}"
CLOSE = f"""async () => {{
  await ({PANEL})().context.save();
  await window.jupyterapp.serviceManager.sessions.shutdownAll();
}}"""


class Memory:
    """Looks at the processes of some accounts, and keeps the largest of each kind."""

    def __init__(self, found: dict[str, dict]) -> None:
        names = list(found)
        self.found = found
        self._names = {pwd.getpwnam(name).pw_uid: name for name in names}
        self.doing = dict.fromkeys(names, "")
        """What each student is at: the peaks are kept by that."""
        self.peaks: dict[str, dict[str, int]] = {name: defaultdict(int) for name in names}
        for name, peaks in self.peaks.items():
            found[name]["memory_mb"] = peaks

    async def watch(self) -> None:
        while True:
            self._look()
            await asyncio.sleep(0.5)

    def _look(self) -> None:
        for pid, name, words in self._processes():
            peaks, doing = self.peaks[name], self.doing[name]
            kind = next((k for k in KINDS if k in words), "")
            if not kind:
                continue
            what = f"{doing} {KINDS[kind]}"
            peaks[what] = max(peaks[what], round(proportional_megabytes(pid)))

    def _processes(self):
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                uid = folder.stat().st_uid
                if uid in self._names:
                    words = (folder / "cmdline").read_text().replace("\0", " ")
                    yield int(folder.name), self._names[uid], words
            except OSError:
                continue


KINDS = {"ipykernel_launcher": "kernel", "madviz explore": "page", "jupyterhub-singleuser": "all"}
"""A word of a process's command line, and what it is; kernels and page are under the last one."""


async def log_in(context: BrowserContext, url: str, name: str, password: str) -> tuple[Page, float]:
    """JupyterLab of a student, and the seconds it took from the click."""
    page = await context.new_page()
    page.set_default_timeout(PATIENCE)
    await page.goto(f"{url}/hub/login")
    await page.fill("#username_input", name)
    await page.fill("#password_input", password)
    began = time.monotonic()
    await page.click("#login_submit")
    await page.wait_for_function("() => window.jupyterapp?.restored.then(() => true)")
    return page, time.monotonic() - began


async def lesson(
    context: BrowserContext, url: str, name: str, file: str, memory: Memory
) -> dict[str, Any]:
    """Runs all cells of a lesson, in a tab of its own, and saves it. A student's copy stops at the
    first missing answer, whose check shows a hint; raises AssertionError where anything else does.
    """
    memory.doing[name] = "start"
    page = await context.new_page()
    page.set_default_timeout(PATIENCE)
    began = time.monotonic()
    await page.goto(f"{url}/user/{name}/lab/tree/{file}.ipynb?reset")
    await notebook_ready(page, f"class-{name}-{file}-not-ready.png")
    await page.evaluate(ANSWERS)
    opened = time.monotonic() - began
    began = time.monotonic()
    await page.evaluate(RESTART)
    await page.evaluate(ANSWERS)
    kernel = time.monotonic() - began
    memory.doing[name] = file[:2]
    began = time.monotonic()
    await page.evaluate(RUN)
    took, errors = time.monotonic() - began, await page.evaluate(ERRORS)
    for error in errors:
        shown = "\n".join(error["traceback"])
        if error["ename"] != "NotYet" or "check" not in error["cell"] or "Hint 1" not in shown:
            raise AssertionError(f"{name}, {file}: expected a missing answer, found {error}")
    await page.screenshot(path=PICTURES / f"class-{name}-{file}.png")
    memory.doing[name] = "end"
    await page.evaluate(CLOSE)
    await page.close()
    return {
        "opened_s": round(opened, 1),
        "kernel_s": round(kernel, 1),
        "cells_s": round(took, 1),
        "stopped_by": [error["evalue"] for error in errors],
    }


async def notebook_ready(page: Page, picture: str) -> None:
    """Waits until the notebook is open and its kernel is connected. Where that does not happen,
    there is a picture, and the error says how everything stands."""
    try:
        await page.wait_for_function(READY)
    except PlaywrightTimeoutError as error:
        await page.screenshot(path=PICTURES / picture)
        state = await page.evaluate(STATE)
        said = f"no notebook after {PATIENCE / 1000:.0f} s: {state}; see {PICTURES / picture}"
        raise AssertionError(said) from error


async def live_page(context: BrowserContext, url: str, name: str, memory: Memory) -> dict[str, Any]:
    """Opens the page from JupyterLab's launcher, and counts what comes through the hub."""
    lab = await context.new_page()
    lab.set_default_timeout(PATIENCE)
    memory.doing[name] = "page"
    await lab.goto(f"{url}/user/{name}/lab?reset")
    await lab.wait_for_function("() => window.jupyterapp?.restored.then(() => true)")
    await lab.evaluate("() => window.jupyterapp.commands.execute('launcher:create')")
    await lab.wait_for_timeout(2000)
    await lab.screenshot(path=PICTURES / f"class-{name}-launcher.png")
    began = time.monotonic()
    async with context.expect_page() as opened:
        await lab.click(
            '.jp-LauncherCard[title*="madviz page"], .jp-LauncherCard:has-text("madviz page")'
        )
    page, received = await opened.value, [0]
    page.set_default_timeout(PAGE_PATIENCE)
    await page.wait_for_url("**/proxy/*/**")

    def count(socket: Any) -> None:
        socket.on("framereceived", lambda _: received.__setitem__(0, received[0] + 1))

    page.on("websocket", count)
    await page.goto(page.url.split("?")[0] + COARSE)
    await page.wait_for_selector("text=Episode", state="attached")
    shown = time.monotonic() - began
    before = received[0]
    await asyncio.sleep(PAGE_SECONDS)
    await page.screenshot(path=PICTURES / f"class-{name}-page.png")
    address, port = page.url, page_port(name)
    return {
        "shown_s": round(shown, 1),
        "messages_a_second": round((received[0] - before) / PAGE_SECONDS, 1),
        "address": address.replace(url, "").split("?")[0],
        "port": port,
    }


def page_port(name: str) -> int:
    """Where the page of a student's server listens."""
    uid = pwd.getpwnam(name).pw_uid
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_text().split("\0")
            if folder.stat().st_uid == uid and "explore" in words:
                return int(words[words.index("--port") + 1])
        except OSError:
            continue
    raise AssertionError(f"{name} has no page")


async def strangers(
    context: BrowserContext, url: str, name: str, other: str, port: int
) -> dict[str, int]:
    """What a student is answered who asks for another one's page, through their own server and
    through the other one's: HTTP statuses."""
    asked = {"own_server": f"/user/{name}/proxy/{port}/", "other_server": f"/user/{other}/lab"}
    return {way: (await context.request.get(f"{url}{path}")).status for way, path in asked.items()}


async def lessons(
    context: BrowserContext, url: str, name: str, password: str, asked: list[str], memory: Memory
) -> None:
    """What a student does first: logs in and runs lessons, one after the other."""
    found = memory.found[name]
    memory.doing[name] = "login"
    page, took = await log_in(context, url, name, password)
    found["login_s"] = round(took, 1)
    await page.close()
    for file in asked:
        found[file] = await lesson(context, url, name, file, memory)


async def whole_class(
    url: str, accounts: dict[str, str], asked: list[str], with_page: bool, found: dict[str, dict]
) -> None:
    """Fills ``found``, one entry for each student."""
    memory, names = Memory(found), list(accounts)
    watching = asyncio.create_task(memory.watch())

    async def all_at_once(what: Callable[[str], Awaitable[None]]) -> None:
        results = await asyncio.gather(*map(what, names), return_exceptions=True)
        for name, result in zip(names, results, strict=True):
            if isinstance(result, Exception):
                found[name].setdefault("failed", []).append(str(result))

    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(
            executable_path=find_browser(), args=[*CHROMIUM_FLAGS, *LIGHT]
        )
        contexts = {
            name: await browser.new_context(viewport={"width": 1280, "height": 900})
            for name in names
        }

        async def first(name: str) -> None:
            await lessons(contexts[name], url, name, accounts[name], asked, memory)

        async def then(name: str) -> None:
            found[name]["page"] = await live_page(contexts[name], url, name, memory)

        async def at_last(name: str) -> None:
            other = names[(names.index(name) + 1) % len(names)]
            found[name]["another_page_status"] = await strangers(
                contexts[name], url, name, other, found[other]["page"]["port"]
            )

        await all_at_once(first)
        if with_page:
            await all_at_once(then)
            await all_at_once(at_last)
        await browser.close()
    watching.cancel()


def free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def main() -> None:
    parser = argparse.ArgumentParser(description="A class at a class server, with browsers.")
    parser.add_argument("--prefix", type=Path, default=Path("/opt/madviz-class"))
    parser.add_argument("--students", type=int, default=4)
    parser.add_argument("--lessons", nargs="*", default=[])
    parser.add_argument("--no-page", dest="page", action="store_false")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    names = [f"mvclass{i:02}" for i in range(1, given.students + 1)]
    tool = [sys.executable, str(SERVER), "--prefix", str(given.prefix)]
    PICTURES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "names").write_text("\n".join(names))
        passwords = Path(place) / "passwords.csv"
        subprocess.run(
            [*tool, "students", "--names", f"{place}/names", "--passwords", str(passwords)],
            check=True,
        )
        accounts = dict(csv.reader(passwords.open()))
        for name in accounts:
            config = Path(pwd.getpwnam(name).pw_dir, ".jupyter", "jupyter_server_config.py")
            config.parent.mkdir()
            config.write_text(EXPOSED)
            shutil.chown(config.parent, name, name)
        port, log = free_port(), (PICTURES / "class-hub.log").open("w")
        hub = subprocess.Popen(
            [*tool, "start", "--address", "127.0.0.1", "--port", str(port)], stdout=log, stderr=log
        )
        url = f"http://127.0.0.1:{port}"
        found: dict[str, dict] = {name: {} for name in accounts}
        result = {"schema": 1, "students": len(found), "cores": os.cpu_count(), "each": found}
        try:
            wait_for(f"{url}/hub/login")
            asked = [
                f.stem
                for f in sorted((given.prefix / "lessons").glob("*.ipynb"))
                if f.stem[:2] in given.lessons
            ]
            asyncio.run(whole_class(url, accounts, asked, given.page, found))
        finally:
            if given.json:  # Also what there is of a run that failed.
                write_json(given.json, result)
            hub.terminate()
            hub.wait(60)
            for name in accounts:
                uid = pwd.getpwnam(name).pw_uid
                end_all(uid)
                subprocess.run(["userdel", "--remove", name], check=False, capture_output=True)
    print(pretty(result))
    sys.exit(any("failed" in one for one in found.values()))


def wait_for(address: str) -> None:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        try:
            urllib.request.urlopen(address, timeout=5)
            return
        except OSError:
            time.sleep(0.3)
    raise AssertionError("the hub did not start")


def end_all(uid: int) -> None:
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if folder.stat().st_uid == uid:
                os.kill(int(folder.name), 9)
        except OSError:
            continue


if __name__ == "__main__":
    main()
