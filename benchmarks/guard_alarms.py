"""``benchmarks guard-alarms``: how soon a guard notices each failure, and its false alarms.

A policy plays intact episodes with all cameras. Beside it, one guard watches the intact pictures,
and for each camera and each failure of ``WAYS`` another one watches what that camera would send. So
one episode answers for all failures. After these, as many episodes are played in which one camera
is moved, and as many in which the robot stands for a while. The result of each policy is kept in
--out, so that a run that was stopped goes on.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np

from madviz.envs.registry import make_env
from madviz.guard.detector import CameraVerdict, Guard
from madviz.guard.policy import GuardedPolicy
from madviz.measure.episodes import one_thread
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.displacement import Displacement
from madviz.observation.streams import StreamStack
from madviz.policies import checkpoint
from madviz.policies.guarded import with_guard
from madviz.policies.players import player_of
from madviz.policies.seeds import FIRST_DEVELOPMENT, seeds_from
from madviz.subsets import camera_of, cameras_of
from madviz.system.files import read_json, write_json
from madviz.system.numbers import Count, Seed
from madviz.types import Array, Environment, View

SCHEMA = 2
WAYS = {
    "black": (Occlusion("black"), 0),
    "frozen": (Occlusion("freeze"), 0),
    "frozen at 20": (Occlusion("freeze"), 20),
    "lossy 50 %": (Occlusion("dropout", 0.5), 0),
    "noise": (Occlusion("noise"), 0),
    "noise 30 %": (Occlusion("noise", 0.3), 0),
    "late by 5": (Occlusion("delay", 0.5), 0),
    "late by 5 at 20": (Occlusion("delay", 0.5), 20),
    "blur": (Occlusion("blur"), 0),
    "blur 30 %": (Occlusion("blur", 0.3), 0),
    "patch": (Occlusion("patch"), 0),
}
"""By name: how a camera fails, and from which step on."""
STANDS = range(15, 30)
"""The decisions at which the robot stands: its action is 0, but for the last number, a gripper's,
which stays as it was."""
MOVED = Displacement(forward=0.05, right=0.05, up=0.03, pan=4, tilt=3)


@dataclass(frozen=True)
class GuardAlarmsConfig:
    """The policies, which have fitted guards, and the episodes: intact ones, as many with a moved
    camera, and as many in which the robot stands."""

    policies: tuple[checkpoint.PolicyName, ...]
    """Names of policies, or their folders."""
    out: Path
    """The folder for the results."""
    episodes: Count = 20
    """Episodes of each policy and condition."""
    seed: Seed = FIRST_DEVELOPMENT
    """The first episode's seed."""
    json: str | None = None
    """Where to write the result, too; - is standard output."""


class NoticedRow(TypedDict):
    """One camera that fails in one way."""

    camera: str
    way: str
    steps: list[int | None]
    """By episode: steps until it was noticed; None: never."""


class AlarmsFile(TypedDict):
    """One policy."""

    schema: int
    policy: str
    seeds: list[int]
    intact: list[str]
    """False alarms in intact episodes: seed, stream, kind and step."""
    moved: list[str]
    """False alarms in episodes with a moved camera."""
    stood: list[str]
    """False alarms in episodes in which the robot stands for a while."""
    noticed: list[NoticedRow]


def guard_alarms(config: GuardAlarmsConfig) -> list[AlarmsFile]:
    """Plays what is missing. Raises UserError for a policy without fitted values."""
    seeds = seeds_from(config.seed, config.episodes)
    config.out.mkdir(parents=True, exist_ok=True)
    results = []
    for name in config.policies:
        policy = checkpoint.load_policy(with_guard(name, True))
        played = f"{seeds[0]}-{len(seeds)}"
        file = config.out / f"{Path(name).name}-{policy.spec.digest[:8]}-{played}.json"
        known = read_json(file) if file.is_file() else {"schema": 0}
        if known["schema"] != SCHEMA:
            assert isinstance(policy, GuardedPolicy)
            write_json(file, _alarms(policy, seeds))
            known = read_json(file)
        results.append(known)
    return results


def alarms_words(results: list[AlarmsFile]) -> str:
    """The results as lines."""
    lines = []
    for found in results:
        count = len(found["seeds"])
        lines.append(
            f"{found['policy']}: {len(found['intact'])} false alarms in {count} intact episodes, "
            f"{len(found['moved'])} in {count} with a moved camera, {len(found['stood'])} in "
            f"{count} in which the robot stands"
        )
        alarms = found["intact"] + found["moved"] + found["stood"]
        lines += [f"  {alarm}" for alarm in alarms]
        for row in found["noticed"]:
            steps = [step for step in row["steps"] if step is not None]
            when = "never noticed"
            if steps:
                when = f"median {np.median(steps):.0f}, 95 % {np.quantile(steps, 0.95):.0f} steps"
            lines.append(f"  {row['camera']} {row['way']}: {len(steps)} of {count}, {when}")
    return "\n".join(lines)


def _alarms(policy: GuardedPolicy, seeds: range) -> AlarmsFile:
    spec = policy.inner.spec
    cameras = cameras_of(spec.streams)
    steps: dict[tuple[str, str], list[int | None]] = {}
    intact: list[str] = []
    moved: list[str] = []
    stood: list[str] = []
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env, one_thread():
        for seed in seeds:
            found = _watched(policy, env, seed, failures=True)
            intact += [f"{seed} {alarm}" for alarm in found.pop(("", ""))]
            for what, alarms in found.items():
                begin = WAYS[what[1]][1]
                since = [int(alarm.split("@")[1]) - begin for alarm in alarms]
                steps.setdefault(what, []).append(min(since, default=None))
        for seed in seeds:
            camera = cameras[seed % len(cameras)]
            env.move_camera(camera, MOVED.placed(env.spec.camera(camera)))
            alarms = _watched(policy, env, seed)["", ""]
            moved += [f"{seed} {alarm}, {camera} is moved" for alarm in alarms]
            env.move_camera(camera, None)
        for seed in seeds:
            alarms = _watched(policy, env, seed, stands=STANDS)["", ""]
            stood += [f"{seed} {alarm}, the robot stands" for alarm in alarms]
    rows: list[NoticedRow] = [
        {"camera": camera, "way": way, "steps": counts} for (camera, way), counts in steps.items()
    ]
    return {
        "schema": SCHEMA,
        "policy": spec.name,
        "seeds": list(seeds),
        "intact": intact,
        "moved": moved,
        "stood": stood,
        "noticed": rows,
    }


def _watched(
    policy: GuardedPolicy,
    env: Environment,
    seed: int,
    failures: bool = False,
    stands: range = range(0),
) -> dict[tuple[str, str], list[str]]:
    """One episode: the alarms, ``stream kind@step``, by camera and way; '' and '' are the intact
    pictures. Only the first alarm of a stream is listed. ``stands``: decisions of a robot that does
    not move."""
    inner = policy.inner
    streams = inner.spec.streams
    watchers = {("", ""): Watcher(policy, env)}
    for camera in cameras_of(streams) if failures else ():
        for way in WAYS:
            watchers[camera, way] = Watcher(policy, env, camera, way)
    now = env.reset(seed)
    step = 0
    last = 0.0
    with closing(player_of(inner, seed)) as player:
        while not now.last:
            views = {camera: env.view(camera) for camera in cameras_of(streams)}
            for watcher in watchers.values():
                watcher.watch(views, now.state, seed, step)
            encoded = inner.encode(watchers["", ""].stack.views, now.state)
            action = player.act(encoded, np.ones(len(streams), bool))
            if step in stands:
                action = np.zeros_like(action)
                action[-1] = last
            last = action[-1]
            now = env.step(action)
            step += 1
    return {what: list(watcher.alarms()) for what, watcher in watchers.items()}


class Watcher:
    """A guard on the pictures of all cameras, or on those of one that fails. An alarm that was
    raised before the failure began is none of it."""

    def __init__(
        self, policy: GuardedPolicy, env: Environment, camera: str = "", way: str = ""
    ) -> None:
        spec = policy.inner.spec
        self.stack: StreamStack = stack_of(spec, env.spec)
        self._streams = [one for one in spec.streams if camera in ("", camera_of(one))]
        self._camera = camera
        self._way = way
        self._begin = WAYS[way][1] if way else 0
        self._guard = Guard(policy.values)
        self._first: dict[str, CameraVerdict] = {}

    def watch(self, views: dict[str, View], state: Array, seed: int, step: int) -> None:
        """The pictures of one step."""
        ablation = Ablation()
        if self._way and step >= self._begin:
            ablation = Ablation({self._camera: CameraState(occlusion=WAYS[self._way][0])})
        self.stack.push(views, ablation, seed, step)
        pictures = {stream: self.stack.newest[stream] for stream in self._streams}
        for stream, verdict in self._guard.step(pictures, state).items():
            if not verdict.fine and (verdict.since or 0) >= self._begin:
                self._first.setdefault(stream, verdict)

    def alarms(self) -> Iterator[str]:
        """The first alarm of each stream."""
        for stream, verdict in self._first.items():
            yield f"{stream} {verdict.kind}@{verdict.since}"
