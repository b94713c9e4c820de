"""When the process begins from which simulations are forked (``session/fork_server.py``).

It imports torch, which takes longer than all else at a start and needs nothing of the page. So
``madviz explore`` starts it before its own modules are imported. Both import at the same time then,
and the first picture comes a second earlier (two cores).

    madviz explore   reads words ─► prepare_for ─► imports viser ─► serves ─► asks for a simulation
    fork server                          └───────► imports torch, simulator ─────────────┴► forks it
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import PurePath

DEFAULT_POLICY = "metaworld-hammer-mad-light"
SHARED = {
    "metaworld": ("glfw",),
    "maniskill": ("mani_skill.envs.tasks.tabletop",),
    "toy": (),
}
"""By suite, modules that take seconds to import and open no device, so that a process can be forked
after it; simulations then share them."""


def shared_imports(task: str) -> tuple[str, ...]:
    """The modules that processes that simulate ``task`` can share."""
    return SHARED.get(task.partition("/")[0], ())


def prepare(task: str = "") -> None:
    """Starts the fork server for simulations of ``task``, without waiting for it. One that runs
    stays as it is."""
    from multiprocessing import forkserver, resource_tracker

    modules = ["madviz.app.session_maker", *shared_imports(task)]
    ends = ("madviz.session.fork_begin", "madviz.session.fork_server")
    get_context("forkserver").set_forkserver_preload([ends[0], *modules, ends[1]])
    resource_tracker.ensure_running()  # Here, as it ends the blocking of signals.
    # Ctrl-C is for the page's process, which ends its children; among imports it is a traceback.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def prepare_for(words: Sequence[str]) -> None:
    """``prepare`` for what follows ``madviz explore``, where these words say which suite will be
    simulated; where they do not, the page says it later."""
    parts = [part for word in words for part in word.split("=", 1)]
    given = dict(zip(parts, parts[1:], strict=False))
    if {"-h", "--help", "--replay", "--recording"} & set(parts):
        return
    names = [given[option] for option in ("--policy", "--task") if option in given]
    suites = [
        suite for name in names or [DEFAULT_POLICY] for suite in SHARED if _is_of(name, suite)
    ]
    if suites:
        prepare(suites[0])


def _is_of(name: str, suite: str) -> bool:
    """True for a task, a policy's name or folder, or sb3:FILE@TASK, of ``suite``."""
    task = name.rpartition("@")[2]
    return task.startswith(f"{suite}/") or PurePath(task).name.startswith(f"{suite}-")
