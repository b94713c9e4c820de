"""A recipe for a visitor's simulation that can be sent to another process."""

from __future__ import annotations

import gc
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from madviz.envs.custom import allow_task
from madviz.envs.registry import make_env
from madviz.policies import checkpoint
from madviz.policies.guarded import reference_to
from madviz.policies.sb3 import trust
from madviz.recorded.known import allow_recording
from madviz.session.commands import Command
from madviz.session.replay import finder
from madviz.session.session import FIRST_SEED, Session
from madviz.session.session_file import SavedEpisode
from madviz.types import CameraSpec, Environment, Policy


@dataclass(frozen=True)
class SessionMaker:
    """Makes sessions that begin alike. ``Session`` says what ``speed`` and ``script`` are."""

    policy: str
    """A name, a folder or module:factory, as ``checkpoint.load_policy`` takes it; of a ``script``,
    the name of its first policy."""
    typed: str | None = None
    """The words that the user typed for --policy: the one place where a script's policies may be
    paths."""
    task: str | None = None
    """A task of the user's own that may be imported."""
    speed: float | None = 10.0
    script: SavedEpisode | None = None
    trusted: bool = False
    """Whether the file that was typed may be loaded, which runs what is in it; see ``sb3.py``."""
    seed: int | None = None
    """The first scene; by default the first one of live pages."""
    begins: tuple[Command, ...] = ()
    """The commands that every session gets first."""
    recording: Path | None = None
    """Recordings that may be opened."""

    def __call__(self, policy: str | None = None) -> Session:
        """A session that is not started yet; it begins with ``policy`` if that is given, and
        ``self.policy`` is never loaded. Raises UserError where a script's policy is gone."""
        allow_task(self.task)
        if self.recording is not None:
            allow_recording(self.recording)
        trust(self.typed, self.trusted)
        known = self._of_script()

        @cache
        def load(name: str) -> Policy:
            if name in known:
                return known[name]
            loaded = checkpoint.load_policy(name)
            # Going through all of it for garbage would cost a step of the simulation each time.
            gc.collect()
            gc.freeze()
            return loaded

        session = Session(
            env_in_one_thread,
            policy or self.policy,
            load,
            seed=FIRST_SEED if self.seed is None else self.seed,
            speed=self.speed,
            script=self.script,
        )
        for command in self.begins:
            session.send(command)
        return session

    def _of_script(self) -> dict[str, Policy]:
        if self.script is None:
            return {}
        find = finder(() if self.typed is None else (self.typed,))
        return {reference_to(policy.name): find(policy) for policy in self.script.policies}


def env_in_one_thread(
    task: str, render_profile: str, cameras: tuple[CameraSpec, ...] = ()
) -> Environment:
    """``make_env``, called by the thread that will own it; that thread computes on one core, as
    evaluation workers do. A policy's small matrices are no quicker on two, and on a busy machine a
    hundred times slower: threads that spin for each other."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    import torch

    torch.set_num_threads(1)
    return make_env(task, render_profile, cameras)
