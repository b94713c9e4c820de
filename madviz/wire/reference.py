"""``ws://host:port`` as the name of a policy, with the file that says how it is wired.

    ws://127.0.0.1:8000                            a server of madviz's own
    ws://127.0.0.1:8000#wire=/home/me/act.toml     any other

A reference goes to worker processes as text, so it carries all that they need to connect.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from madviz.errors import UserError
from madviz.system.address import ServerAddress, without_secrets
from madviz.system.typed import typed
from madviz.wire.connection import PolicyConnection
from madviz.wire.policy import ServedPolicy
from madviz.wire.protocols import OURS, greeted, identity_in
from madviz.wire.specification import check_specification
from madviz.wire.wiring import (
    PolicyFacts,
    Wiring,
    checked,
    env_of,
    policy_spec,
    read_wiring,
    served_spec,
    subsets_there,
)

MARK = "#wire="


def is_served(policy: str) -> bool:
    """Whether the name is an address."""
    return policy.startswith(("ws://", "wss://"))


def with_wire(policy: str, wire: Path | None) -> str:
    """``policy`` without secrets, with the file of ``--wire``. Raises UserError for a file beside
    no address."""
    policy = without_secrets(policy)
    if wire is None:
        return policy
    if not is_served(policy):
        raise UserError(
            f"--wire is for --policy ws://HOST:PORT, found --policy {policy or 'none'!s:.100}"
        )
    return f"{policy.split(MARK)[0]}{MARK}{wire.resolve()}"


def plain(policy: str) -> str:
    """``policy`` as it may be shown to others: no token, and no path but its last part."""
    address, _, file = policy.partition(MARK)
    if not is_served(policy):
        return Path(policy).name
    return ServerAddress.of(address).text + (f"{MARK}{Path(file).name}" if file else "")


def connect(reference: str) -> ServedPolicy:
    """The policy behind ``reference``, greeted once: what it says of itself is checked, and the
    file, and one against the other, before anything is drawn. Raises UserError."""
    written, _, file = reference.partition(MARK)
    address = ServerAddress.of(written)
    wiring = read_wiring(file) if file else None
    timeout = wiring.timeout if wiring else 4.0
    with closing(PolicyConnection(address, timeout)) as connection:
        speaker, greeting = greeted(connection, wiring.protocol if wiring else None)
    where = address.text
    identity = identity_in(greeting)
    if wiring is not None:
        wiring = msgspec.structs.replace(wiring, protocol=speaker.name)
        check_specification(greeting, wiring, env_of(wiring), where)
        spec = policy_spec(wiring, where, identity)
        supported = None
        if OURS in greeting and wiring.masks:
            facts = _facts(greeting, where)
            trained, known = subsets_there(facts, wiring)
            if not set(known) - {"none"}:
                raise UserError(
                    f"{where}: expected cameras that this policy can act on, found "
                    f"{', '.join(wiring.cameras)}; it calls its own "
                    f"{', '.join(map(str, facts.wiring.cameras.values())):.200}, and needs more "
                    "of them in [cameras]"
                )
            spec = replace(spec, trained_subsets=tuple(trained))
            supported = frozenset(known)
        return ServedPolicy(address, wiring, spec, supported, identity)
    if OURS not in greeting:
        raise UserError(
            f"{where}: expected a server that says how it is wired, found one that speaks "
            f"{speaker.name} and does not; write that down in a file, and give it with --wire"
        )
    facts = _facts(greeting, where)
    wiring = checked(msgspec.structs.replace(facts.wiring, protocol=speaker.name), where)
    check_specification(greeting, wiring, env_of(wiring), where)
    spec = served_spec(facts, wiring, where)
    return ServedPolicy(address, wiring, spec, frozenset(facts.supported), identity, said=True)


def _facts(greeting: dict[str, Any], where: str) -> PolicyFacts:
    return typed(greeting[OURS], PolicyFacts, where, "it runs another version of madviz")


def rewired(policy: ServedPolicy, wiring: Wiring) -> ServedPolicy:
    """The policy of the same server, reached by another file; nothing is connected yet."""
    spec = policy_spec(wiring, policy.address.text, policy.identity)
    cameras = tuple(replace(camera, size=wiring.largest) for camera in policy.spec.cameras)
    spec = replace(spec, cameras=cameras)
    return ServedPolicy(policy.address, wiring, spec, None, policy.identity)
