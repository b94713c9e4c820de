"""``madviz guard --policy P``: fits the values of a policy's guard, guard.json beside it.

The policy plays intact episodes of training seeds (``policies/seeds.py``) with all cameras. In
every second one, a fifth of its decisions are random, so that the robot is also seen elsewhere, and
for a quarter of the episode it stands, so that the guard knows how much a robot that stands moves.
For a policy that learned from recordings, its training episodes play as they were recorded.
"""

from __future__ import annotations

from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np

from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.guard.fit import (
    FEWEST,
    SeenEpisode,
    blank_steps,
    blind_streams,
    fit_values,
    seen_episode,
)
from madviz.guard.policy import GuardedPolicy
from madviz.guard.values import FILE, write_values
from madviz.measure.episodes import one_thread
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Ablation
from madviz.policies import checkpoint
from madviz.policies.config import check_environment
from madviz.policies.guarded import unguarded
from madviz.policies.players import player_of
from madviz.policies.seeds import FIRST_TRAINING, seeds_from
from madviz.recorded.known import allow_recording, is_recording, recordings_of
from madviz.recorded.recordings import Recordings
from madviz.recorded.robot import Robot
from madviz.subsets import cameras_of
from madviz.system.files import read_json, written_to
from madviz.system.numbers import Count
from madviz.types import Array, Environment, Policy, PolicySpec

FIRST_SEED = FIRST_TRAINING + 900
"""The last hundred training seeds."""
RANDOM = 0.2
"""The share of random decisions in every second episode."""
STANDS = slice(0.5, 0.75)
"""The part of such an episode in which every number of the action is 0; in every second one, the
last number, often a gripper's, stays as it was."""


@dataclass(frozen=True)
class GuardConfig:
    """Fits the values of a policy's guard on intact episodes."""

    policy: checkpoint.PolicyName
    """A name of a policy, its folder, or module:factory."""
    episodes: Count = 12
    """Intact episodes to fit on, of training seeds."""
    out: Path | None = None
    """Where to write the values; by default guard.json in the policy's folder."""
    json: str | None = None
    """Where to write what was fitted; - is standard output."""
    recording: Path | None = None
    """The recordings, a LeRobot dataset, that the policy learned from."""


class FittedFile(TypedDict):
    """The document that ``madviz guard --json`` writes."""

    schema: int
    policy: str
    file: str
    bytes: int
    seeds: list[int]
    """The seeds of the episodes; recordings have their numbers in the dataset here."""
    late: dict[str, bool]
    """By stream: True where the robot's movements alone show that a picture is late."""
    blind: list[str]
    """Streams that show nothing in half of their pictures or more: black is not noticed there."""
    left_out: list[str]
    """A line for each episode that cannot be decoded, and for each stream's blank pictures."""


def run_guard(config: GuardConfig) -> FittedFile:
    """``madviz guard``. Raises UserError for too few episodes or too many, for recordings that the
    policy did not learn from, and for a place that cannot be written to."""
    reference = unguarded(config.policy)
    if config.episodes < FEWEST:
        raise UserError(f"expected {FEWEST} episodes or more to fit on, found {config.episodes}")
    recorded = None if config.recording is None else allow_recording(config.recording)
    if config.out is None and not checkpoint.is_folder(reference):
        raise UserError(f"expected --out FILE for {reference!r:.100}, which has no folder; add it")
    out = config.out or checkpoint.find_policy(reference) / FILE
    written_to(out, "--out")
    _check_places(out, config)
    policy = checkpoint.load_policy(reference)
    spec = policy.spec
    if recorded not in (None, spec.task):
        raise UserError(
            f"expected a policy of {recorded}, found {spec.name!r} of {spec.task}; leave out "
            "--recording, or name the recordings that it learned from"
        )
    left_out: list[str] = []
    if is_recording(spec.task):
        robot = checkpoint.robot_of_policy(reference)
        recordings = recordings_of(spec.task)
        seeds, faults = training_places(recordings, robot, spec, config.episodes)
        left_out = list(dict.fromkeys([*recordings.left_out, *faults]))
        named = tuple(recordings.episodes[place].index for place in seeds)
    else:
        seeds = tuple(seeds_from(FIRST_SEED, config.episodes))
        named = seeds
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env, one_thread():
        check_environment(spec, env.spec)
        episodes = [
            play_intact(policy, env, seed, disturbed=number % 2 == 1)
            for number, seed in enumerate(seeds)
        ]
        places = env.spec.state_numbers.robot
    size = (spec.image_size, spec.image_size)
    values = fit_values(episodes, size, places, named)
    write_values(out, values)
    return {
        "schema": 1,
        "policy": spec.name,
        "file": str(out),
        "bytes": out.stat().st_size,
        "seeds": list(named),
        "late": {name: bool(stream.numbers) for name, stream in values.streams.items()},
        "blind": blind_streams(episodes, size),
        "left_out": [*left_out, *_blank_words(blank_steps(episodes, size), named)],
    }


def training_places(
    recordings: Recordings, robot: Robot | None, spec: PolicySpec, most: int
) -> tuple[tuple[int, ...], list[str]]:
    """The places, among all episodes, of the first ``most`` that the policy of ``robot`` was
    trained on, or that are not held out where there is no robot: the seeds that begin them. And a
    line for each before these that cannot be decoded. Raises UserError for other recordings than it
    learned from, and for fewer than four such episodes."""
    if robot is not None:
        robot.check_units(recordings)
    unseen = recordings.held_out if robot is None else robot.unseen(recordings)
    places: list[int] = []
    faults: list[str] = []
    for place, one in enumerate(recordings.episodes):
        if one.index in unseen or len(places) == most:
            continue
        if fault := recordings.fault(one.index, spec.image_size):
            faults.append(fault)
        else:
            places.append(place)
    if len(places) < FEWEST:
        found = "; ".join([f"{len(places)}", *faults[:1]])
        raise UserError(
            f"{recordings.path}: expected {FEWEST} episodes or more that the policy was trained "
            f"on, found {found}; name the recordings that it learned from"
        )
    return tuple(places), faults


def _check_places(out: Path, config: GuardConfig) -> None:
    """Raises UserError where --json would replace the values at ``out``, and where --out would
    replace a file that holds none."""
    if config.json is not None and Path(config.json).resolve() == out.resolve():
        raise UserError(f"expected --json beside the values, found both at {out}; name another")
    if config.out is not None and out.is_file() and out.stat().st_size:
        found = None
        with suppress(UserError):
            found = read_json(out)
        if not (isinstance(found, dict) and {"schema", "streams"} <= found.keys()):
            raise UserError(
                f"expected --out for values of a guard, found another file in {out}; name another, "
                "or remove it first"
            )


def _blank_words(blank: dict[str, list[tuple[int, int]]], seeds: tuple[int, ...]) -> list[str]:
    """A line for each stream of ``blank_steps``."""
    return [
        f"{name}: {len(steps)} even or dark picture{'s' * (len(steps) > 1)}, the first at step "
        f"{steps[0][1]} of episode {seeds[steps[0][0]]}"
        for name, steps in blank.items()
        if steps
    ]


def play_intact(policy: Policy, env: Environment, seed: int, disturbed: bool) -> SeenEpisode:
    """The episode ``seed`` with all cameras; ``disturbed``: with random decisions (``RANDOM``) and
    none (``STANDS``) among the policy's. A policy with a guard acts without it."""
    policy = policy.inner if isinstance(policy, GuardedPolicy) else policy
    streams = policy.spec.streams
    stack = stack_of(policy.spec, env.spec)
    rng = np.random.default_rng(seed)
    pictures: list[dict[str, Array]] = []
    states: list[Array] = []
    last = 0.0
    now = env.reset(seed)
    with closing(player_of(policy, seed)) as player:
        while not now.last:
            views = {camera: env.view(camera) for camera in cameras_of(streams)}
            stack.push(views, Ablation(), seed, len(states))
            pictures.append(stack.newest)
            states.append(now.state)
            action = player.act(policy.encode(stack.views, now.state), np.ones(len(streams), bool))
            if disturbed and STANDS.start <= len(states) / env.spec.horizon < STANDS.stop:
                action = np.zeros_like(action)
                action[-1] = last if seed % 4 == 3 else 0
            elif disturbed and rng.random() < RANDOM:
                action = rng.uniform(-1, 1, action.shape).astype(action.dtype)
            last = action[-1]
            now = env.step(action)
    return seen_episode(pictures, np.array(states))


def guard_words(fitted: FittedFile) -> str:
    """The text that the command prints."""
    without = [name for name, readable in fitted["late"].items() if not readable]
    late = (
        f"In {', '.join(without)}, lateness is noticed only where a picture repeats."
        if without
        else "Late pictures can be told in every stream."
    )
    blind = ", ".join(fitted["blind"])
    return (
        f"{fitted['file']}: {fitted['bytes']} bytes, fitted on {len(fitted['seeds'])} intact "
        f"training episodes, {_stretches(fitted['seeds'])}. {late}"
        + (f"\nHalf of the pictures or more are even or dark in {blind}: " if blind else "")
        + ("a camera that sends black is not noticed there." if blind else "")
        + "".join(f"\nLeft out: {line}" for line in fitted["left_out"])
    )


def _stretches(seeds: list[int]) -> str:
    """``0 to 8, 10, 12 to 14``."""
    stretches: list[list[int]] = []
    for seed in seeds:
        if stretches and seed == stretches[-1][-1] + 1:
            stretches[-1].append(seed)
        else:
            stretches.append([seed])
    words = (f"{one[0]} to {one[-1]}" if len(one) > 1 else f"{one[0]}" for one in stretches)
    return ", ".join(words)
