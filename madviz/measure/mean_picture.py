"""The mean picture of every camera: what it sees on average, and so nothing of this episode.

A camera that cannot be dropped has to send something. Black is a picture that no training has
shown; the mean picture is near those it has, blurred where things move or differ between episodes.
It is the same for every episode and step, so that what a policy still does with it comes from
elsewhere.

The task's expert plays EPISODES episodes, of whose pictures PICTURES each are averaged, pixel by
pixel, spread over the episode: 8 x 5 = 40 pictures. With a horizon of 100 they are those of the
steps 0, 20, 40, 60 and 80. The seeds are selection seeds (``policies/seeds.py``), no scene that a
reported rate is measured on. The same environment gives the same picture to the bit, so worker
processes make theirs by themselves, once each. On Meta-World that takes some seconds.

A task of one's own that has no expert is moved at random.
On recordings they are those of about eight training episodes, five or more steps of each.
"""

from __future__ import annotations

from contextlib import closing
from functools import lru_cache

import numpy as np

from madviz.envs.checks import expert_action
from madviz.envs.custom import is_own
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.observation.streams import IMAGE_SIZE, MeanPictures, StreamStack, stream_frame
from madviz.policies.seeds import FIRST_SELECTION
from madviz.recorded.known import recordings_of
from madviz.recorded.recordings import Recordings
from madviz.subsets import camera_of, cameras_of
from madviz.system.streams import say
from madviz.types import Environment, EnvSpec, PolicySpec

FIRST_SEED = FIRST_SELECTION + 900
"""The last hundred selection seeds: evaluations while a policy trains use the first ones."""
EPISODES = 8
PICTURES = 5


@lru_cache(maxsize=4)
def mean_pictures(env: EnvSpec, streams: tuple[str, ...], size: int = IMAGE_SIZE) -> MeanPictures:
    """The mean picture of each of ``streams``, (H, W, C) uint8, H and W being ``size``, from an
    environment of its own with the cameras where ``env`` has them; made at the first call."""
    if env.recorded:
        return recorded_means(recordings_of(env.task), streams, size)[0]
    frames: list[MeanPictures] = []
    with closing(make_env(env.task, env.render_profile, env.cameras)) as world:
        expert = _has_expert(world)
        for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
            frames += _frames(world, expert, seed, env.horizon, streams, size)
    return {
        stream: np.round(np.mean([one[stream] for one in frames], axis=0)).astype(np.uint8)
        for stream in streams
    }


def _frames(
    world: Environment, expert: bool, seed: int, length: int, streams: tuple[str, ...], size: int
) -> list[MeanPictures]:
    """The frames (H, W, C) of ``streams`` at PICTURES steps of an episode of ``length`` decisions.
    One that ends earlier is played again, so that all of its pictures are from before its end."""
    steps = {round(length * number / PICTURES) for number in range(PICTURES)}
    found = []
    world.reset(seed)
    rng = np.random.default_rng(seed)
    for step in range(max(steps) + 1):
        if step in steps:
            views = {camera: world.view(camera) for camera in cameras_of(streams)}
            found.append(
                {s: stream_frame(views[camera_of(s)], s, world.spec, size) for s in streams}
            )
        drawn = rng.uniform(-1, 1, world.spec.action_dim).astype(np.float32)
        ended = world.step(expert_action(world) if expert else drawn).last
        if ended and step < max(steps):
            return _frames(world, expert, seed, step + 1, streams, size)
    return found


def _has_expert(world: Environment) -> bool:
    """False for a task of one's own that has none, which is said."""
    if not is_own(world.spec.task):
        return True
    world.reset(FIRST_SEED)
    try:
        expert_action(world)
    except UserError as error:
        say(f"{error}; mean pictures are those of random movements")
        return False
    return True


def recorded_means(
    recordings: Recordings, streams: tuple[str, ...], size: int
) -> tuple[MeanPictures, list[str]]:
    """The mean picture of each of ``streams`` in the training episodes, and a line for each episode
    that was chosen and cannot be decoded. Raises UserError if none of these can."""
    names = [camera.name for camera in recordings.cameras]
    pictures: list[np.ndarray] = []
    faults: list[str] = []
    for index in recordings.training[:: max(1, len(recordings.training) // 8)]:
        if fault := recordings.fault(index, size):
            faults.append(fault)
            continue
        frames = recordings.frames(index, size)  # (T, V, H, W, 3)
        pictures.append(frames[:: max(1, len(frames) // 5)].mean(axis=0))
    if not pictures:
        raise UserError(f"expected a training episode that can be decoded, found none: {faults[0]}")
    mean = np.round(np.mean(pictures, axis=0)).astype(np.uint8)  # (V, H, W, 3)
    return {stream: mean[names.index(stream)] for stream in streams}, faults


def stack_of(policy: PolicySpec, env: EnvSpec) -> StreamStack:
    """An empty stack of what ``policy`` gets in ``env``; a camera may send its mean picture."""
    return StreamStack(
        env,
        policy.streams,
        policy.frame_stack,
        policy.image_size,
        lambda: mean_pictures(env, policy.streams, policy.image_size),
    )
