"""The static site on hosts of all kinds: what they call its files, and what they forbid."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from madviz.site.site import SiteConfig, run_site
from tests.e2e.static_site import MAD, QuietHandler, fake_site, served, toy_recording, until

PATIENCE = 120_000
STRICT = "default-src 'self'; img-src 'self' data: blob:"
NO_MEMORY = """
WebAssembly.Memory = class { constructor() { throw new RangeError(
  'WebAssembly.Memory(): could not allocate memory'); } };
"""
"""Before a worker's own script: a device that gives no memory."""


def host(
    encoded: bool = False, kinds: dict[str, str] | None = None, **headers: str
) -> type[QuietHandler]:
    """A static host that marks ``.gz`` as encoded, calls files by ``kinds``, or adds headers."""

    class Host(QuietHandler):
        extensions_map = {**QuietHandler.extensions_map, **(kinds or {})}

        def end_headers(self) -> None:
            if encoded and self.path.endswith(".gz"):
                self.send_header("Content-Encoding", "gzip")
            for name, value in headers.items():
                self.send_header(name.replace("_", "-"), value)
            super().end_headers()

    return Host


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with one policy that runs, and a recording of the toy, in a folder below the root."""
    root = tmp_path_factory.mktemp("hosts")
    out = root / "deep" / "below"
    run_site(SiteConfig(str(out), (MAD,), seeds="5000:5001", recorded=0))
    line = toy_recording(out)
    file = out / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "recordings": [line]}))
    return root


@pytest.fixture
def opened(browser) -> Iterator[Callable[[str], Any]]:
    contexts = []

    def go(url: str) -> Any:
        contexts.append(browser.new_context(viewport={"width": 1000, "height": 800}))
        page = contexts[-1].new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(url)
        return page

    yield go
    for context in contexts:
        context.close()


def plays(page: Any) -> None:
    """The simulation has made its first decision."""
    page.wait_for_selector("body[data-ready]")
    assert page.locator("#notices .notice").all_inner_texts() == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "handler",
    [
        host(encoded=True),
        host(kinds={".gz": "text/plain", ".json": "text/html", ".css": "text/css"}),
        host(Cross_Origin_Opener_Policy="same-origin", Cross_Origin_Embedder_Policy="require-corp"),
        host(Content_Security_Policy=STRICT.replace("'self';", "'self' blob: 'unsafe-eval';")),
    ],
    ids=["encoded", "wrong types", "isolated", "strict but enough"],
)
def test_the_simulation_runs_below_a_path(site, opened, handler) -> None:
    with served(site, handler) as url:
        plays(opened(f"{url}deep/below/"))


@pytest.mark.slow
def test_a_policy_of_the_host_that_forbids_it_is_named_and_recordings_play(site, opened) -> None:
    with served(site, host(Content_Security_Policy=STRICT)) as url:
        page = opened(f"{url}deep/below/")
        said = until(page, "Content-Security-Policy", "#notices")
        assert "'unsafe-eval'" in said and "What follows are recorded episodes" in said
        until(page, "A recording", ".side .about")


@pytest.mark.slow
def test_where_memory_is_refused_recordings_play(site, opened) -> None:
    class Refusing(QuietHandler):
        """Gives workers a script before their own, as a small device would act."""

        def do_GET(self) -> None:
            if not self.path.endswith("/worker.js"):
                super().do_GET()
                return
            own = Path(self.translate_path(self.path)).read_text()
            # Imports come first in a module, and the memory is made long after.
            body = f"{own}\n{NO_MEMORY}".encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/javascript")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    with served(site, Refusing) as url:
        page = opened(f"{url}deep/below/")
        said = until(page, "memory", "#notices")
        assert "256 MB" in said and "What follows are recorded episodes" in said
        until(page, "A recording", ".side .about")


def test_a_host_that_calls_modules_plain_text_is_told_so(tmp_path, opened) -> None:
    folder = fake_site(tmp_path / "site")
    with served(folder, host(kinds={".js": "text/plain"})) as url:
        assert "text/javascript" in until(opened(url), "did not start", "#loading-words")


def test_a_site_whose_network_is_gone_says_so(tmp_path, opened) -> None:
    folder = fake_site(tmp_path / "site")

    class Gone(QuietHandler):
        """Hangs up where the site's list is asked for."""

        def do_GET(self) -> None:
            if self.path.endswith("manifest.json"):
                self.close_connection = True
                return
            super().do_GET()

    with served(folder, Gone) as url:
        assert "are you connected?" in until(opened(url), "could not be fetched", "#notices")


def test_a_download_that_stands_still_says_so(tmp_path, opened) -> None:
    folder = fake_site(tmp_path / "site")

    class Silent(QuietHandler):
        """Sends nothing of the site's list for a while."""

        def do_GET(self) -> None:
            if self.path.endswith("manifest.json"):
                time.sleep(14)
            super().do_GET()

    with served(folder, Silent) as url:
        page = opened(url)
        assert "nothing has come for 1" in until(page, "stands still", "#loading-words")
        page.wait_for_selector("body[data-ready]")
