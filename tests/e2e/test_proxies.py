"""The page behind a reverse proxy, and in a frame of another site."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

from madviz.app.access import Gate
from madviz.app.server import App
from tests.e2e.conftest import PATIENCE, toy_app

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs" / "install.md"
UNPACKED = ROOT / ".venv" / "nginx" / "usr" / "sbin"
WEBSOCKET = """proxy_http_version 1.1; proxy_set_header Upgrade $http_upgrade;
proxy_set_header Connection "upgrade";"""


def documented() -> str:
    """The directives inside the block ``location`` of the documentation."""
    (block,) = re.findall(r"```nginx\nlocation /lab/ \{\n(.*?)\}\n```", DOCS.read_text(), re.S)
    return block.replace("proxy_pass http://127.0.0.1:8080/;", "")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def app() -> Iterator[App]:
    app = toy_app(visitors=4)
    yield app
    app.stop()


@pytest.fixture(scope="module")
def proxied(app: App, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """nginx before the page: by scheme, the address of the proxy."""
    nginx = shutil.which("nginx", path=f"{UNPACKED}:{os.environ['PATH']}")
    assert nginx is not None, "expected nginx, found none; make .venv/nginx.stamp unpacks it"
    folder = tmp_path_factory.mktemp("nginx")
    key = ["-newkey", "rsa:2048", "-nodes", "-keyout", "key.pem", "-out", "cert.pem"]
    named = ["-days", "2", "-subj", "/CN=localhost"]
    subprocess.run(
        ["openssl", "req", "-x509", *key, *named], cwd=folder, check=True, capture_output=True
    )
    places = {
        "/lab/": documented(),
        "/bare/": WEBSOCKET,
        "/host/": WEBSOCKET + "proxy_set_header Host $host;",
        "/forwarded/": WEBSOCKET
        + "proxy_set_header Host $host; proxy_set_header X-Forwarded-Port $server_port;",
        "/closed/": "proxy_http_version 1.1; proxy_set_header Host $http_host;",
    }
    locations = "\n".join(
        f"location {place} {{ proxy_pass {app.url}/; {words} }}" for place, words in places.items()
    )
    http = free_port()
    https = free_port()
    temporary = " ".join(
        f"{kind}_temp_path {folder}/{kind};"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (folder / "nginx.conf").write_text(
        f"""daemon off; worker_processes 1; pid {folder}/pid; error_log {folder}/error.log;
        events {{}}
        http {{ access_log off; {temporary}
          server {{ server_name localhost; listen 127.0.0.1:{http}; listen 127.0.0.1:{https} ssl;
            ssl_certificate {folder}/cert.pem; ssl_certificate_key {folder}/key.pem;
            location / {{ proxy_pass {app.url}; {documented()} }}
            {locations} }} }}"""
    )
    process = subprocess.Popen(
        [nginx, "-c", f"{folder}/nginx.conf", "-e", f"{folder}/error.log"],
        stderr=subprocess.DEVNULL,
    )
    try:
        yield {"http": f"http://localhost:{http}", "https": f"https://localhost:{https}"}
    finally:
        process.terminate()
        process.wait(10)


@pytest.fixture
def opened(browser) -> Iterator[Callable]:
    """Opens an address; whatever its certificate is."""
    contexts = []

    def go(url: str):
        contexts.append(browser.new_context(ignore_https_errors=True))
        page = contexts[-1].new_page()
        page.goto(url)
        return page

    yield go
    for context in contexts:
        context.close()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["http", "https"])
@pytest.mark.parametrize("place", ["/", "/lab/", "/forwarded/"])
def test_the_page_works_behind_the_documented_proxy(proxied, opened, scheme, place) -> None:
    page = opened(proxied[scheme] + place)
    page.wait_for_selector(".mv-status", timeout=PATIENCE)
    assert page.locator("#mv-arrival").count() == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "place, says",
    [
        ("/bare/", "X-Forwarded-Host"),
        ("/host/", "you opened localhost:"),
        ("/closed/", "proxy_set_header Upgrade"),
    ],
)
def test_the_page_says_which_header_the_proxy_lacks(proxied, opened, place, says) -> None:
    page = opened(proxied["http"] + place)
    page.wait_for_selector("#mv-arrival", timeout=PATIENCE)
    assert says in page.locator("#mv-arrival").inner_text()


@contextmanager
def site_with_frame(folder: Path, address: str) -> Iterator[str]:
    """Another site (localhost is not 127.0.0.1) whose page has ``address`` in a frame."""
    (folder / "index.html").write_text(f'<iframe src="{address}" width=1000 height=600></iframe>')

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            """Nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://localhost:{server.server_address[1]}/"
    finally:
        server.shutdown()


@pytest.fixture
def guarded() -> Iterator[App]:
    app = toy_app(visitors=2, gate=Gate(visit="t", local=True))
    yield app
    app.stop()


def test_a_frame_of_another_site_gets_in_with_its_token(guarded, opened, tmp_path) -> None:
    with site_with_frame(tmp_path, f"{guarded.url}/?token=t") as site:
        page = opened(site)
        page.frame_locator("iframe").locator(".mv-status").wait_for(timeout=PATIENCE)


def test_a_token_that_is_typed_in_a_frame_opens_it(guarded, opened, tmp_path) -> None:
    with site_with_frame(tmp_path, guarded.url) as site:
        frame = opened(site).frame_locator("iframe")
        frame.locator("input[name=token]").fill("t")
        frame.get_by_role("button").click()
        frame.locator(".mv-status").wait_for(timeout=PATIENCE)


def test_a_frame_without_its_cookie_says_so_with_a_link(guarded, opened) -> None:
    """As a browser does that keeps no cookie for a frame over http."""
    page = opened(f"{guarded.url}/?entered=")
    assert "in a frame of another site" in page.locator("body").inner_text()
    link = page.get_by_role("link")
    assert link.get_attribute("target") == "_blank"
    with page.context.expect_page() as other:
        link.click()
    other.value.locator("input[name=token]").wait_for(timeout=PATIENCE)
