"""Who reaches what is served here, and what they have to know."""

from __future__ import annotations

import ipaddress
import secrets


def new_token() -> str:
    """128 random bits as text for an address."""
    return secrets.token_urlsafe(16)


def stays_here(host: str) -> bool:
    """Whether only this machine reaches what is served on ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
