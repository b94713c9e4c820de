"""Visitors who do whatever there is to do, and what a session keeps of it."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any, get_args

import numpy as np

from madviz.envs.registry import make_env
from madviz.observation.ablation import CameraState, Occlusion, OcclusionKind
from madviz.observation.schedule import parse_schedule
from madviz.session.commands import (
    Fork,
    Play,
    Reset,
    Scrub,
    SetCamera,
    SetPolicy,
    SetSchedule,
)
from madviz.session.frame import Frame
from madviz.session.session import Session
from madviz.session.session_file import SavedPolicy, SavedSession
from madviz.types import CameraSpec, Policy, View
from tests.fakes import FakePolicy, policies

CAMERAS = ("first", "third_a", "third_b")
NAMES = ("toy-mad", "toy-rgbd", "toy-other")
KINDS = get_args(OcclusionKind)


def find(policy: SavedPolicy) -> Policy:
    return policies(policy.name)


class Interrupted:
    """A toy world in which things are sent while a camera is being drawn."""

    def __init__(self, *world: Any) -> None:
        self._env = make_env(*world)
        self.meanwhile: Any = lambda: None

    def view(self, camera: str, size: int | None = None) -> View:
        self.meanwhile()
        return self._env.view(camera, size)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)


def session_with(world: list[Interrupted], **options: Any) -> Session:
    def build(task: str, profile: str, cameras: tuple[CameraSpec, ...]) -> Any:
        world.append(Interrupted(task, profile, cameras))
        return world[-1]

    session = Session(build, FakePolicy(), policies, speed=None, **options)
    session.tick(0.0)
    return session


def random_camera(rng: np.random.Generator) -> SetCamera:
    width, height = rng.random(2).tolist()
    kind = str(rng.choice(KINDS))
    occlusion = Occlusion(kind, float(rng.random()), width=width, height=height)  # type: ignore[arg-type]
    state = CameraState(str(rng.choice(["rgb", "depth", "both", "off", "both"])), occlusion)  # type: ignore[arg-type]
    return SetCamera(str(rng.choice(CAMERAS)), state)


def random_command(rng: np.random.Generator, step: int) -> Any:
    draw = rng.random()
    if draw < 0.72:
        return random_camera(rng)
    if draw < 0.86:
        return SetPolicy(str(rng.choice(NAMES)))
    if draw < 0.92:
        words = ["third_a@3-9", "first=noise:0.5@5", "third_b=freeze@2-20"]
        return SetSchedule(parse_schedule(words[: rng.integers(4)], CAMERAS))
    if draw < 0.96 and step > 1:
        return Scrub(int(rng.integers(step)))
    return Fork() if draw < 0.98 else Reset(next_seed=bool(rng.integers(2)))


@cache
def played(seed: int, steps: int) -> SavedSession:
    """A session with a wild visitor, who also clicks while pictures are drawn. Nobody changes
    it."""
    rng, world = np.random.default_rng(seed), []
    session = session_with(world, seed=seed)

    def meanwhile() -> None:
        if rng.random() < 0.15:
            session.send(random_camera(rng))

    for tick in range(steps):
        world[-1].meanwhile = meanwhile
        step = session.latest.world.step if isinstance(session.latest, Frame) else 0
        for _ in range(int(rng.integers(3))):
            session.send(random_command(rng, step))
        session.send(Play())
        session.tick(float(tick))
    return session.save()


def put(document: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy with ``value`` at ``a.0.b``."""
    changed = copy.deepcopy(document)
    *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    place: Any = changed
    for parent in parents:
        place = place[parent]
    place[last] = value  # type: ignore[index]
    return changed
