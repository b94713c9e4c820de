"""The two protocols, as a client speaks them: how a server is greeted, asked and answered.

                 vla-eval                                openpi
    greeting     client: hello, server: hello            server: a table about itself
    episode      client: episode_start                   (the server remembers nothing)
    a look       observation {images, state, ...}        {their keys: pictures, state, prompt}
    an answer    action {actions}, or error              {actions, ...}, or a text with an error

Which one it is, is heard: an openpi server speaks first. Every vla-eval message is a table with
type, payload, a number that the answer repeats, and a time.
"""

from __future__ import annotations

import time
from typing import Any

from madviz.types import Array
from madviz.wire.codec import Protocol
from madviz.wire.connection import OPENING, PolicyConnection
from madviz.wire.keys import put
from madviz.wire.wiring import Wiring

LISTEN = 1.0
"""Seconds in which an openpi server has spoken."""
OURS = "madviz"
"""Under this key of the greeting, servers of madviz's own say all about the policy."""
BOXED = "boxed"
"""The key by which a client of ours says that its pictures are as in training, bars and all."""
IDENTITY = ("name", "model_server", "model", "policy", "checkpoint", "revision", "digest")
"""Keys of a greeting that say which policy is served; ``digest`` is one of its weights."""
VERSION = 1
"""The version of vla-eval's protocol."""


REFUSED = "look at the server, and at the file of --wire"
"""The move where a server answers, but with no action: the look may be wrong."""


class VlaEval:
    """See the module. Both protocols are spoken on a connection that is open."""

    name: Protocol = "vla-eval"

    def __init__(self) -> None:
        self._number = 0

    def greet(self, connection: PolicyConnection) -> dict[str, Any]:
        """The server's description of itself, before anything else is said."""
        self._tell(connection, "hello", {"harness_version": "madviz", "protocol_version": VERSION})
        return self._answer(connection, "hello", "a greeting of vla-eval or openpi")

    def begin(self, connection: PolicyConnection, seed: int, task: str) -> None:
        """An episode begins."""
        self._tell(connection, "episode_start", {"task": {"name": task}, "seed": seed})

    def ask(self, connection: PolicyConnection, message: dict[str, Any]) -> dict[str, Any]:
        """The server's answer to one look."""
        number = self._tell(connection, "observation", message)
        return self._answer(connection, "action", "an action", number)

    def _tell(self, connection: PolicyConnection, kind: str, payload: dict[str, Any]) -> int:
        self._number += 1
        message = {"type": kind, "payload": payload, "seq": self._number, "timestamp": time.time()}
        connection.tell(message, self.name)
        return self._number

    def _answer(
        self, connection: PolicyConnection, kind: str, expected: str, number: int | None = None
    ) -> dict[str, Any]:
        found = connection.hear(expected, OPENING if kind == "hello" else None)
        payload = found.get("payload") if isinstance(found, dict) else None
        if not isinstance(payload, dict):
            move = 'if it speaks another protocol, say so: protocol = "openpi" in --wire'
            raise connection.wrong(expected, _kind(found), move)
        if found.get("type") == "error":
            said = f"the error {str(payload.get('error', payload))!r:.200}"
            raise connection.wrong(expected, said, REFUSED)
        if found.get("type") != kind:
            raise connection.wrong(
                expected, f"a message of the type {str(found.get('type'))!r:.40}"
            )
        if number is not None and found.get("seq") != number:
            raise connection.wrong(
                f"the answer to question {number}", f"that to {found.get('seq')!r:.20}"
            )
        return payload


class OpenPi:
    """See the module."""

    name: Protocol = "openpi"

    def __init__(self, greeting: dict[str, Any] | None = None) -> None:
        """``greeting``: what the server has said already."""
        self._greeting = greeting

    def greet(self, connection: PolicyConnection) -> dict[str, Any]:
        greeting = self._greeting
        self._greeting = None
        found = connection.hear("a greeting of openpi", OPENING) if greeting is None else greeting
        if not isinstance(found, dict):
            raise connection.wrong("a greeting of openpi", _kind(found))
        return found

    def begin(self, connection: PolicyConnection, seed: int, task: str) -> None:
        """There is nothing to say."""

    def ask(self, connection: PolicyConnection, message: dict[str, Any]) -> dict[str, Any]:
        connection.tell(message, self.name)
        found = connection.hear("an action")
        if not isinstance(found, dict):
            raise connection.wrong("an action", _kind(found), REFUSED)
        return found


Speaker = VlaEval | OpenPi
SPEAKERS: dict[Protocol, type[VlaEval] | type[OpenPi]] = {"vla-eval": VlaEval, "openpi": OpenPi}


def greeted(
    connection: PolicyConnection, wanted: Protocol | None
) -> tuple[Speaker, dict[str, Any]]:
    """Opens ``connection`` and greets the server: the protocol it speaks, ``wanted`` or found out,
    and what it says of itself. Raises UserError."""
    ours = connection.open()
    if wanted is None and not ours:
        first = connection.heard_first(LISTEN)
        speaker = VlaEval() if first is None else OpenPi(first)
    else:
        speaker = SPEAKERS["vla-eval" if ours else wanted or "vla-eval"]()
    return speaker, speaker.greet(connection)


def identity_in(greeting: dict[str, Any]) -> dict[str, str]:
    """The words of a server on the policy that it serves; empty where it says nothing."""
    facts = greeting.get(OURS)
    facts = facts if isinstance(facts, dict) else greeting
    return {key: facts[key][:200] for key in IDENTITY if isinstance(facts.get(key), str)}


def look(
    wiring: Wiring,
    protocol: Protocol,
    pictures: dict[str, Array],
    state: Array,
    instruction: str,
    noise: int,
) -> dict[str, Any]:
    """A look as ``protocol`` sends it: the pictures (H, W, C) uint8 that are present, by stream,
    and the rest, each under its key."""
    values: dict[str, Any] = {"instruction": instruction, "state": state, "noise": noise}
    streams = {name: wiring.stream(name) for name in wiring.cameras}
    values |= {f"cameras.{name}": pictures[s] for name, s in streams.items() if s in pictures}
    message: dict[str, Any] = {"images": {}} if protocol == "vla-eval" else {}
    for entry, path in wiring.paths(protocol).items():
        if entry in values:
            put(message, path, values[entry])
    return message


def _kind(found: Any) -> str:
    return f"a message that is no {'answer' if isinstance(found, dict) else 'table'}"
