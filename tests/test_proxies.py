"""The page behind proxies and in frames, without a browser."""

from __future__ import annotations

import gzip
import urllib.parse
import urllib.request
from collections.abc import Iterator

import pytest
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from madviz.app.access import Gate
from madviz.app.proxies import ARRIVAL, cookie_rules, names_of, query_of, with_script
from madviz.app.server import App
from tests.pages import fake_app


def request(path: str = "/", **headers: str) -> Request:
    return Request(path, Headers({k.replace("_", "-"): v for k, v in headers.items()}))


@pytest.fixture(scope="module")
def app() -> Iterator[App]:
    app = fake_app("toy-mad", gate=Gate(local=True))
    yield app
    app.stop()


def told(app: App, origin: str, **headers: str) -> str:
    """The answer to the script that came with the page at ``origin``."""
    address = f"{app.url}{ARRIVAL}?origin={urllib.parse.quote(origin)}"
    asked = urllib.request.Request(address, headers=headers)
    return urllib.request.urlopen(asked).read().decode()


def test_names_are_those_of_the_host_and_of_the_proxy() -> None:
    assert names_of(request(Host="a:80", X_Forwarded_Host="B, c:1")) == ["a:80", "b", "c:1"]
    assert names_of(request(Host="lab", X_Forwarded_Port="8243")) == ["lab", "lab:8243"]


def test_the_page_is_told_which_header_is_missing(app: App) -> None:
    assert told(app, app.url) == ""
    said = told(app, "https://lab.org:8243")
    assert "you opened lab.org:8243" in said and "X-Forwarded-Host" in said
    assert told(app, "https://lab.org:8243", **{"X-Forwarded-Host": "lab.org:8243"}) == ""


def test_the_script_comes_before_viser_zipped_or_not() -> None:
    page = b"<html><head><script>viser</script></head></html>"
    for zipped in (False, True):
        body = gzip.compress(page) if zipped else page
        headers = Headers({"Content-Type": "text/html; charset=utf-8"})
        headers["Content-Encoding"] = "gzip" if zipped else "identity"
        headers["Content-Length"] = str(len(body))
        answer = with_script(Response(200, "OK", headers, body))
        assert answer is not None and answer.body is not None
        assert answer.headers["Content-Length"] == str(len(answer.body))
        text = gzip.decompress(answer.body) if zipped else answer.body
        assert text.index(b"madviz-arrival") < text.index(b"viser</script>")
    picture = Response(200, "OK", Headers({"Content-Type": "image/png"}), b"<head>")
    assert with_script(picture) is picture and with_script(None) is None


def test_a_frame_gets_a_cookie_of_its_own_where_a_browser_keeps_it() -> None:
    framed = {"Sec_Fetch_Dest": "iframe"}
    assert "Partitioned" in cookie_rules(request(Host="127.0.0.1:8080", **framed))
    assert "Partitioned" in cookie_rules(request(Host="a", X_Forwarded_Proto="https", **framed))
    for other in (request(Host="lab:8080", **framed), request(Host="127.0.0.1:8080")):
        assert cookie_rules(other) == "Path=/; HttpOnly; SameSite=Lax"


def test_who_was_given_a_cookie_is_known_by_the_address() -> None:
    assert "entered" in query_of(request("/?entered="))
    assert "entered" not in query_of(request("/?fixedDpr=1"))
