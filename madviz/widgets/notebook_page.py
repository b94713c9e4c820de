"""Pages inside a notebook: a server in the background, and an iframe on the right address.

The problem: a notebook's browser and its kernel may be on two machines. ``127.0.0.1:41234`` is then
the wrong one, but the notebook's own server can pass requests on (jupyter-server-proxy):

    direct   http://127.0.0.1:41234/           the browser and the kernel share a machine
    proxy    /user/ada/proxy/41234/            through the notebook's server, from anywhere

The page asks for its parts relative to its own address, so the slash at the end matters: without
it, they would be asked for in ``/proxy/``. Which server a kernel belongs to is read from the
environment (JupyterHub), or from the file that the kernel's parent writes about itself.

Google Colab passes a port on, too, but no websockets (its makers call that a known limitation), and
the live page is all websocket. There, an ``Explorer`` shows the same in a cell.
"""

from __future__ import annotations

import atexit
import importlib.util
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from html import escape
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import rich

from madviz.errors import UserError

Where = Literal["auto", "direct", "proxy"]
PATIENCE = 60.0
"""Seconds for rerun's viewer to start on a busy machine."""


class LivePage:
    """A running page; displaying it shows it in the notebook. ``close`` ends it."""

    def __init__(self, app, where: Where, height: int) -> None:
        self._app = app
        self._height = height
        self.port: int = app.server.get_port()
        asked: str | None = app.gate.visit
        self.url = address(self.port, where) + (f"?token={asked}" if asked else "")
        self.direct: str = app.url
        """Its address on the kernel's own machine."""

    def close(self) -> None:
        """Frees the port and ends every simulation."""
        with quietly():
            self._app.stop()

    def __repr__(self) -> str:
        return f"[the live page, at {self.url}]"

    def _repr_html_(self) -> str:
        return iframe("madviz-page", self.url, self._height)


class Viewer:
    """Rerun's viewer on a recording, served from this machine.

    It works without a network. Where there is one, its page by itself contacts its makers for
    fonts, announcements and statistics, so a lesson shows it only on request. Its data comes
    through a second port that no proxy passes on, so browser and kernel must share a machine;
    otherwise copy the file and open it there with ``rerun FILE``.
    """

    def __init__(self, file: Path, height: int = 620) -> None:
        """Raises UserError if it does not start."""
        self._height, (page, data) = height, free_ports(2)
        words = [rerun_program(), str(file), "--serve-web", "--bind", "127.0.0.1"]
        words += ["--web-viewer-port", str(page), "--port", str(data)]
        quiet = subprocess.DEVNULL
        self._server = subprocess.Popen(words, stdin=quiet, stdout=quiet, stderr=quiet)
        atexit.register(self.close)
        source = quote(f"rerun+http://127.0.0.1:{data}/proxy", safe="")
        self.url = f"http://127.0.0.1:{page}/?url={source}"
        self._wait_for(page)

    def _wait_for(self, port: int) -> None:
        """A frame that is loaded before the server listens stays empty."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline and self._server.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            time.sleep(0.05)
        self.close()
        raise UserError("expected rerun's viewer to start, found none; does `rerun FILE` work?")

    def close(self) -> None:
        """Ends the server."""
        atexit.unregister(self.close)
        self._server.terminate()
        self._server.wait(30)

    def __repr__(self) -> str:
        return f"[rerun's viewer, at {self.url}]"

    def _repr_html_(self) -> str:
        return iframe("madviz-rerun", self.url, self._height)


def iframe(kind: str, url: str, height: int) -> str:
    """HTML that shows the page at ``url``."""
    return (
        f'<iframe class="{kind}" src="{escape(url)}" width="100%" height="{height}" '
        'style="border:0"></iframe>'
    )


def rerun_program() -> str:
    """The viewer itself: `python -m rerun` would start it as a child, and leave it behind when it
    is ended. Raises UserError where it is not installed."""
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise UserError("expected rerun's viewer, found none; pip install rerun-sdk")
    return str(Path(package.origin).with_name("rerun.exe" if os.name == "nt" else "rerun"))


def free_ports(count: int) -> list[int]:
    """Ports of this machine that are free now."""
    with ExitStack() as stack:
        probes = [stack.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in probes]


def live_page(
    policy: str | None = None,
    *,
    where: Where = "auto",
    height: int = 720,
    visitors: int = 4,
    workers: int = 0,
) -> LivePage:
    """Starts ``madviz explore`` on a free port of this machine. ``workers`` measure success in the
    background. Raises UserError for a policy that cannot be found."""
    from madviz.app.server import ExploreConfig, open_app
    from madviz.teaching import begin

    begin()
    address(0, where)  # Where no browser could open it, it is not started.
    config = ExploreConfig(policy=policy, port=0, visitors=visitors, workers=workers)
    with quietly():
        return LivePage(open_app(config), where, height)


@contextmanager
def quietly() -> Iterator[None]:
    """Keeps viser from printing a banner into the cell: it has the kernel's address, which a
    browser elsewhere cannot open."""
    console = rich.get_console()
    before = console.quiet
    console.quiet = True
    try:
        yield
    finally:
        console.quiet = before


def address(port: int, where: Where = "auto") -> str:
    """The address that a browser should open for ``port`` of this machine; always with a slash at
    the end.

    Raises UserError if the proxy is asked for and the notebook's server cannot be found, and in
    Colab.
    """
    if where == "auto" and "google.colab" in sys.modules:
        raise UserError(
            "expected a notebook server that passes websockets on, found Google Colab, which does "
            "not; use madviz.widgets.Explorer in a cell"
        )
    base = None if where == "direct" else base_url()
    if where == "proxy" and base is None:
        raise UserError(
            "expected a notebook server with jupyter-server-proxy, found none; use where='direct'"
        )
    return f"http://127.0.0.1:{port}/" if base is None else f"{base.rstrip('/')}/proxy/{port}/"


def base_url() -> str | None:
    """The path under which this kernel's notebook server is found; None where there is none, or no
    proxy in it."""
    if importlib.util.find_spec("jupyter_server_proxy") is None:
        return None
    hub = os.environ.get("JUPYTERHUB_SERVICE_PREFIX")
    if hub:
        return hub
    try:
        from ipykernel.connect import get_connection_file

        # A server writes a file about itself beside the connection files of its kernels.
        file = Path(get_connection_file()).with_name(f"jpserver-{os.getppid()}.json")
        return str(json.loads(file.read_text())["base_url"])
    except (ImportError, RuntimeError, OSError, ValueError, KeyError):
        return None
