"""Addresses of servers, whose text is without what opens them.

    written    ws://me:password@host:8000/act?token=T
    text       ws://host:8000/act

An address is a policy's name: it goes to pages, files, logs and cards, and to other processes. So
its text holds no secret. The user name, the password and the query are kept beside it, in the
environment of this process, where the processes that it starts find them.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlsplit, urlunsplit

KEPT = "MADVIZ_ADDRESS_SECRETS"
"""The variable of the environment: by text, what stands before ``@`` and what follows ``?``."""
HIDDEN = "***"
SHORTEST = 4
"""Letters of the shortest value that is taken out of a server's own words."""
_WRITTEN = re.compile(r"wss?://[^\s#]+")


@dataclass(frozen=True)
class ServerAddress:
    """Where a server is. ``of`` makes it from what a user wrote."""

    text: str
    """The address as anybody may see it."""

    @classmethod
    def of(cls, written: str) -> ServerAddress:
        """The address that is ``written``. Its secrets are kept for this process and for those that
        it starts; one without any has those that were kept last."""
        try:
            parts = urlsplit(written)
        except ValueError:  # Such as an unclosed bracket: no server has such an address.
            return cls(written.partition("?")[0].rpartition("@")[2])
        user, _, place = parts.netloc.rpartition("@")
        path = "" if parts.path == "/" else parts.path
        text = urlunsplit((parts.scheme, place, path, "", ""))
        if user or parts.query:
            os.environ[KEPT] = json.dumps({**_kept(), text: [user, parts.query]})
        return cls(text)

    def __str__(self) -> str:
        return self.text

    @property
    def whole(self) -> str:
        """The address with its secrets: to connect with, and for nothing else."""
        user, query = _kept().get(self.text, ("", ""))
        parts = urlsplit(self.text)
        place = f"{user}@{parts.netloc}" if user else parts.netloc
        return urlunsplit((parts.scheme, place, parts.path or ("/" if query else ""), query, ""))

    def hide(self, words: str) -> str:
        """``words`` of the server, or about it, without any secret of this address."""
        user, query = _kept().get(self.text, ("", ""))
        values = [value for _, value in parse_qsl(query)]
        for secret in sorted({user, query, *user.split(":"), *values}, key=len, reverse=True):
            if len(secret) >= SHORTEST:
                words = words.replace(secret, HIDDEN)
        return words


def without_secrets(words: str) -> str:
    """``words``, as of a command line, with the text alone of each address in it."""
    return _WRITTEN.sub(lambda found: ServerAddress.of(found[0]).text, words)


def _kept() -> dict[str, list[str]]:
    return json.loads(os.environ.get(KEPT, "{}"))
