"""Sessions for tests: one whose clock the test moves, and one frame after some commands."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from madviz.envs.registry import make_env
from madviz.envs.toy import ToyReach
from madviz.observation.ablation import CameraState, Occlusion
from madviz.session.frame import Frame
from madviz.session.session import Session
from madviz.types import CameraSpec, Policy
from tests.fakes import FakePolicy, policies

OFF = CameraState("off")
BLACK = CameraState("rgb", occlusion=Occlusion("black"))


class Recorder(Session):
    """A session that keeps its frames, on a clock the test moves."""

    def __init__(self, policy=None, env_factory=make_env, load=policies, **kwargs) -> None:
        super().__init__(env_factory, policy or FakePolicy(), load, **kwargs)
        self.frames: list[Frame] = []
        self.subscribe(lambda frame: self.frames.append(frame))  # type: ignore[arg-type]
        self.time = 0.0

    def tick(self, now: float) -> float | None:
        """A replay of an ended episode takes no time."""
        due = super().tick(now)
        while self._stage.retracing:
            due = super().tick(now)
        return due

    def at(self, time: float) -> float | None:
        self.time = time
        return self.tick(time)

    def steps(self, count: int) -> Frame:
        """Lets ``count`` due moments pass."""
        for _ in range(count):
            due = self.tick(self.time)
            assert due is not None
            self.time = max(self.time, due)
            self.tick(self.time)
        return self.frames[-1]

    def ask(self, *commands) -> Frame:
        for command in commands:
            self.send(command)
        self.tick(self.time)
        return self.frames[-1]


def any_task(task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> ToyReach:
    """An ``env_factory``: the toy, under the name of any task."""
    env = ToyReach("reach", render_profile, cameras)
    env.spec = replace(env.spec, task=task)
    return env


def elsewhere(name: str) -> FakePolicy:
    """A ``load``: as ``policies``, and ``elsewhere``, a policy of another task."""
    return FakePolicy(name, task="metaworld/push") if name == "elsewhere" else policies(name)


def frame_with(*commands, policy: Policy | None = None) -> Frame:
    """The frame after ``commands``, at the first step of an episode."""
    session = Session(make_env, policy or FakePolicy(), policies)
    session.tick(0.0)
    for command in commands:
        session.send(command)
    session.tick(0.0)
    assert isinstance(session.latest, Frame)
    return session.latest


def with_world(frame: Frame, **fields: Any) -> Frame:
    """``frame`` with other values in its world."""
    return replace(frame, world=replace(frame.world, **fields))


def with_pace(frame: Frame, **fields: Any) -> Frame:
    """``frame`` with other values in its pace."""
    return replace(frame, pace=replace(frame.pace, **fields))
