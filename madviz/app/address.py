"""Where a page is served, and what others call that place."""

from __future__ import annotations

import socket
from dataclasses import dataclass

from madviz.app.access import Gate
from madviz.errors import UserError


@dataclass(frozen=True)
class Address:
    """Where a page is served, and who gets in."""

    host: str = "127.0.0.1"
    port: int = 0
    """0 takes a free one."""
    gate: Gate | None = None
    """None lets everybody in; one with a presenter's token makes the page a presentation."""


def check_port(host: str, port: int) -> None:
    """Raises UserError if ``port`` is taken; viser would silently take the next one. Also
    for a ``host`` that is no address of this machine."""
    if not host:
        raise UserError(
            "--host: expected an address, found none; 0.0.0.0 serves on all of this machine's"
        )
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, UnicodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "not a name of a machine"
            raise UserError(
                f"port {port} on {host:.60} cannot be served ({why}); choose another with --port, "
                "or another --host"
            ) from error


def with_token(address: str, token: str | None) -> str:
    """An address that opens the page for whoever has it."""
    return f"{address}/?token={token}" if token else address


def reached_at(host: str) -> str:
    """How other machines call ``host``. For 0.0.0.0 that is the address from which this machine
    would reach others; asking for it sends nothing."""
    if host != "0.0.0.0":
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("10.255.255.255", 9))
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])
