"""Between a browser and this page: reverse proxies, and frames of other sites.

A proxy that is set up as for any page breaks a websocket, and the browser then shows "Connecting"
for ever. So a script comes with the page (``browser/arrive.js``), before viser's own:

    prefix    viser's client leaves out the last slash of an address: wss://host/lab is another
              place than wss://host/lab/. The script says which one is meant
    headers   where no websocket opens, it asks ``ARRIVAL`` what the proxy has passed on, and says
              which header is missing

In a frame of another site a browser takes a cookie only where it is for that site alone
(``Partitioned``), and only over https or from this machine. Elsewhere the page says so, with a link
to a tab of its own: a browser that comes back without the cookie that it was given has ``ENTERED``
in its address.
"""

from __future__ import annotations

import gzip
from functools import lru_cache
from http import HTTPStatus
from urllib.parse import parse_qsl, urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from madviz.app.browser import read
from madviz.system.hosts import stays_here

ARRIVAL = "/madviz-arrival"
"""Where the script asks, with the address of its page as ``origin``."""
ENTERED = "entered"
LACKS = (
    "The proxy before this page hides the address that you opened: it passes on {}, and you opened "
    "{}. Let it send the header X-Forwarded-Host (nginx: proxy_set_header X-Forwarded-Host "
    "$http_host;)."
)
NO_COOKIE = (
    "This page is in a frame of another site, and over http a browser keeps no cookie for it. "
    '<a href="./" target="_blank">Open it in a tab of its own</a>.'
)


def names_of(request: Request) -> list[str]:
    """The names, with ports, under which a browser may have asked: of this server, and of a proxy
    before it."""
    hosts = request.headers.get_all("Host")
    names = [*hosts, *request.headers.get_all("X-Forwarded-Host")]
    for port in request.headers.get_all("X-Forwarded-Port"):
        names += [f"{host}:{port.strip()}" for host in hosts]
    parts = [part for name in names for part in name.split(",")]
    return [part.strip().lower() for part in parts]


def host_of(address: str) -> str | None:
    """``name:port`` of an address; None of one that cannot be read."""
    try:
        return urlsplit(address).netloc.lower()
    except ValueError:
        return None


def query_of(request: Request) -> dict[str, str]:
    """The query of a request's address; of a key that is there twice, the last value."""
    return dict(parse_qsl(urlsplit(request.path).query, keep_blank_values=True))


def arrival(request: Request, refused: str) -> Response | None:
    """The answer to the script's question, which is ``refused`` if that says something; None where
    it is another request."""
    asked = urlsplit(request.path)
    if asked.path != ARRIVAL:
        return None
    origin = host_of(query_of(request).get("origin", "")) or ""
    names = names_of(request)
    said = (
        refused if origin in names else LACKS.format(" and ".join(names) or "no name", origin[:200])
    )
    return text(HTTPStatus.OK, said, "text/plain")


def text(status: HTTPStatus, said: str, kind: str = "text/html") -> Response:
    """A page of its own, of a few words."""
    body = said.encode()
    headers = Headers(
        {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
        }
    )
    return Response(status, status.phrase, headers, body)


def with_script(response: Response | None) -> Response | None:
    """viser's page with our script before its own; anything else as it is."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    zipped = response.headers.get("Content-Encoding") == "gzip"
    body = _page(bytes(response.body or b""), zipped)
    headers = Headers(response.headers)
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(body))
    return Response(response.status_code, response.reason_phrase, headers, body)


@lru_cache(maxsize=2)
def _page(body: bytes, zipped: bool) -> bytes:
    page = gzip.decompress(body) if zipped else body
    script = f"<script>\n{read('arrive.js')}</script>".encode()
    page = page.replace(b"<head>", b"<head>" + script, 1)
    return gzip.compress(page) if zipped else page


def comes_from_elsewhere(request: Request) -> bool:
    """True where a page of another site led here."""
    referer = request.headers.get("Referer")
    return referer is not None and host_of(referer) not in names_of(request)


def cookie_rules(request: Request) -> str:
    """The rules of this page's cookie for a browser."""
    https = "https" in request.headers.get("X-Forwarded-Proto", "").split(",")[0]
    own = urlsplit(f"//{request.headers.get('Host', '')}").hostname or ""
    framed = request.headers.get("Sec-Fetch-Dest") == "iframe"
    if framed and (https or stays_here(own)):
        return "Path=/; HttpOnly; SameSite=None; Secure; Partitioned"
    return "Path=/; HttpOnly; SameSite=Lax"
