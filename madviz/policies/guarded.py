"""``guard:NAME`` as the name of a policy: the policy NAME with a guard (``madviz.guard``).

The guard's fitted values are beside the policy, in guard.json. A reference goes to worker processes
as text; ``--guard`` makes it.
"""

from __future__ import annotations

from pathlib import Path

from madviz.guard.policy import SUFFIX
from madviz.recorded.known import is_recording

PREFIX = "guard:"


def is_guarded(policy: str) -> bool:
    """True where the name means a policy with a guard."""
    return policy.startswith(PREFIX)


def with_guard(policy: str, on: bool) -> str:
    """``policy`` with a guard, if ``on``."""
    return f"{PREFIX}{policy}" if on and not is_guarded(policy) else policy


def unguarded(policy: str) -> str:
    """``policy`` without its guard."""
    return policy.removeprefix(PREFIX)


def reference_to(name: str) -> str:
    """The reference of the policy that a file calls ``name``."""
    return with_guard(name.removesuffix(SUFFIX), name.endswith(SUFFIX))


def fit_command(policy: str | Path, task: str) -> str:
    """The command that fits the guard of ``policy``, which learned ``task``."""
    source = f" --recording {task.partition('/')[2]}" if is_recording(task) else ""
    return f"madviz guard --policy {policy}{source}"
