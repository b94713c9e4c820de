"""Messages are obeyed when they come, where viser would hold them back for up to 0.1 s.

The problem: viser's page plays messages at the pace at which the server wrote them, by the time
that is stamped on each. Let one come 60 ms late, because the browser was busy. It sets a new pace:
all that follow are held back until they are as late, and win back a twentieth of the time between
two.

    written    0   40   80  120  160  ...   ms
    comes      0  100  101  125  165
    obeyed     0  100  138  175  213  ...   and still 50 ms late: 30 messages until that is gone

That is right for an animation that shall be smooth. It is wrong for a camera that a visitor has
just dropped.

The idea: the page holds back nothing that was written more than 0.1 s after the message before it.
So the clock that stamps messages runs ``FASTER`` times as fast. Nothing else on the page reads it.
"""

from __future__ import annotations

import time
from typing import Any

from viser.infra import _infra

FASTER = 100_000
"""Two messages are never closer than some 10 microseconds, which look like a second."""


class _Fast:
    """The module ``time`` for viser's sender, but for the clock it stamps messages with."""

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)

    @staticmethod
    def perf_counter() -> float:
        return FASTER * time.perf_counter()


def obey_at_once() -> None:
    """For all servers of this process; call it as often as you like."""
    _infra.time = _Fast()  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]
