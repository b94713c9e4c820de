"""Who reaches what is served here, and what they have to know."""

from __future__ import annotations

import hmac
import ipaddress
import os
import secrets
import socket

from madviz.errors import UserError


def new_token() -> str:
    """128 random bits as text for an address."""
    return secrets.token_urlsafe(16)


def machine_token() -> str | None:
    """The token that every page here asks for because whoever set up this machine says so
    (``MADVIZ_TOKEN``): where several people have accounts, all of them reach 127.0.0.1."""
    return os.environ.get("MADVIZ_TOKEN") or None


def stays_here(host: str) -> bool:
    """Whether only this machine reaches what is served on ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def same_token(said: str, token: str | None) -> bool:
    """Whether ``said`` is the token, in a time that does not tell how much of it was right."""
    expected = (token or new_token()).encode()
    return hmac.compare_digest(said.encode("utf-8", "replace"), expected) and token is not None


def with_token(address: str, token: str | None) -> str:
    """An address that opens what is served for anybody who has it."""
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
            raise port_error(host, port, error) from error


def port_error(host: str, port: int, error: Exception) -> UserError:
    """The error to raise where ``error`` came of serving at ``host`` and ``port``."""
    why = getattr(error, "strerror", None) or "not a name of a machine"
    return UserError(
        f"port {port} on {host:.60} cannot be served ({why}); choose another with --port, or "
        "another --host"
    )
