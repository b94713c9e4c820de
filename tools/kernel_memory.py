"""Where the memory of a lesson's kernel goes: ``python tools/kernel_memory.py [FILE.json]``.

Does what lesson 2 does, step by step, with the class server's variables (jupyterhub_config.py), and
writes after each step the memory of this process in MB: proportional (PSS), and the part of it that
no other process can share.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

VARIABLES = {"OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
POLICY = "metaworld-hammer-mad-light"


def memory() -> tuple[int, int]:
    """MB of this process: proportional, and its own."""
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()[1:]
    found = {line.split(":")[0]: int(line.split()[1]) for line in lines}
    return round(found["Pss"] / 1024), round(found["Pss_Anon"] / 1024)


def steps() -> dict[str, Callable[[], Any]]:
    """What a kernel does, in order; what a step returns is kept until the end."""

    def policy() -> Any:
        return import_module("madviz").load_policy(POLICY)

    def moment() -> Any:
        teaching = import_module("madviz.teaching")
        teaching.begin()
        return teaching.moment_at(policy(), seed=2000, step=20)

    return {
        "Python and the kernel": lambda: import_module("ipykernel.kernelapp"),
        "NumPy": lambda: import_module("numpy"),
        "torch": lambda: import_module("torch"),
        "madviz.teaching": lambda: import_module("madviz.teaching"),
        "widgets": lambda: import_module("madviz.widgets"),
        "a policy": policy,
        "a simulator, three cameras, 20 decisions": moment,
        "an Explorer, with a simulator of its own": lambda: import_module(
            "madviz.widgets"
        ).Explorer(POLICY, seed=2001),
    }


def main(words: list[str]) -> None:
    if not VARIABLES.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **VARIABLES})
    kept, rows = [], []
    for what, do in steps().items():
        kept.append(do())
        rows.append({"after": what, **dict(zip(("pss_mb", "own_mb"), memory(), strict=True))})
    text = json.dumps({"schema": 1, "torch": import_module("torch").__version__, "steps": rows})
    if words:
        Path(words[0]).write_text(text + "\n")
    print(text)
    sys.stdout.flush()
    os._exit(0)  # The Explorer's simulation still runs.


if __name__ == "__main__":
    main(sys.argv[1:])
