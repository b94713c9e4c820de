"""Who reaches what is served here, and what they have to know."""

from __future__ import annotations

import ipaddress
import os
import secrets


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
