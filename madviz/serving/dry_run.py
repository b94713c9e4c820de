"""``madviz serve --check DATASET``: the answers to one recorded episode, before a robot moves.

Every frame of an episode that the policy was not trained on is answered as a client's look would
be, with the recorded state, whatever was answered before: open loop.
"""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path

import numpy as np

from madviz.errors import UserError
from madviz.measure.episodes import one_thread
from madviz.recorded.known import LABEL
from madviz.recorded.recordings import Recordings, open_recordings
from madviz.recorded.robot import Robot
from madviz.serving.episodes import ServedEpisodes
from madviz.types import Array, Policy

IN_TIME = 0.95
"""The share of the answers that must come within the time of a frame."""


def dry_run(policy: Policy, robot: Robot | None, dataset: Path) -> list[str]:
    """The lines that the command prints; the last one sums up. Raises UserError for a policy that
    did not learn from recordings, and for a dataset of another robot."""
    if robot is None:
        raise UserError(
            f"expected a policy that learned from recordings for --check, found "
            f"{policy.spec.name!r}; train one with madviz train --recording"
        )
    recordings = open_recordings(dataset)
    robot.check(recordings)
    episode, held, faults = _episode(recordings, robot, policy.spec.image_size)
    states, recorded = recordings.numbers(episode)
    actions, seconds, notes = _answers(policy, robot, recordings, episode, states)
    jumps = _jumps(robot, actions)
    rate = 1 / float(np.quantile(seconds, IN_TIME))
    outside = robot.outside(states)  # (T, S)
    names = [robot.state_names[i] for i in np.flatnonzero(np.any(outside, axis=0))]
    lines = [
        f"{policy.spec.name}: {len(states)} frames of episode {episode} of {recordings.name} "
        f"({held}); {LABEL}.",
        f"answers: {rate:.1f} a second or more in {IN_TIME:.0%} of the frames, here and without a "
        f"network; the robot was recorded at {robot.fps:g}",
        _jump_words(jumps, _jumps(robot, recorded)),
        f"outside the range of the training episodes: {_outside_words(names, outside)}",
        f"from the recorded actions: {_apart(robot, actions, recorded):.2f} spreads on average",
    ]
    if notes:
        lines.append(f"the guard: {notes[0][1]}, first at step {notes[0][0]}, {len(notes)} steps")
    lines += [f"left out: {line}" for line in faults]
    return [*lines, _sentence(rate, robot.fps, jumps, len(names))]


def _episode(recordings: Recordings, robot: Robot, size: int) -> tuple[int, str, list[str]]:
    """The episode to answer to, whether the policy was trained on it, in words, and a line for each
    one that was left out, or comes before it and cannot be decoded. Raises UserError if none can.
    """
    unseen = robot.unseen(recordings)
    others = (one.index for one in reversed(recordings.episodes) if one.index not in unseen)
    faults = list(recordings.left_out)
    for episode in (*unseen, *others):
        if fault := recordings.fault(episode, size):
            faults.append(fault)
        elif not robot.trained_on:
            return episode, "whether the policy was trained on it is not known", faults
        elif episode in unseen:
            return episode, "the policy was not trained on it", faults
        else:
            every = "" if unseen else ", as on all that are here"
            return episode, f"the policy was trained on it{every}", faults
    raise UserError(f"{recordings.path}: expected a whole episode, found none; {faults[-1]}")


def _answers(
    policy: Policy, robot: Robot, recordings: Recordings, episode: int, states: Array
) -> tuple[Array, Array, list[tuple[int, str]]]:
    """Actions (T, A) raw, seconds (T,), and the guard's notes with their steps."""
    names = [camera.name for camera in recordings.cameras]
    frames = recordings.frames(episode, policy.spec.image_size)  # (T, V, H, W, 3)
    actions: list[Array] = []
    seconds: list[float] = []
    notes: list[tuple[int, str]] = []
    served = ServedEpisodes(policy, len(robot.state_names), robot)
    with closing(served), one_thread():
        for step, state in enumerate(states):
            pictures = np.array(frames[step])
            images = {stream: pictures[names.index(stream)] for stream in policy.spec.streams}
            began = time.perf_counter()
            actions.append(served.act(images, state))
            seconds.append(time.perf_counter() - began)
            if served.note:
                notes.append((step, served.note))
    return np.stack(actions), np.array(seconds), notes


def _jumps(robot: Robot, actions: Array) -> Array:
    """(T - 1,) distances from each of ``actions`` (T, A), raw, to the next, in spreads."""
    scaled = robot.actions.scale(actions)
    return robot.distance(scaled[1:], scaled[:-1]) if len(actions) > 1 else np.zeros(1)


def _jump_words(jumps: Array, recorded: Array) -> str:
    return (
        f"largest jump between two actions: {jumps.max():.2f} spreads, from step "
        f"{int(jumps.argmax())}; the largest recorded one is {recorded.max():.2f}"
    )


def _outside_words(names: list[str], outside: Array) -> str:
    if not names:
        return "nothing"
    steps = int(np.any(outside, axis=1).sum())
    return f"{', '.join(names):.200}, in {steps} of {len(outside)} frames"


def _apart(robot: Robot, actions: Array, recorded: Array) -> float:
    return float(robot.distance(robot.actions.scale(actions), robot.actions.scale(recorded)).mean())


def _sentence(rate: float, fps: float, jumps: Array, outside: int) -> str:
    pace = "keeps up with" if rate >= fps else "is slower than"
    state = f"{outside} state numbers" if outside != 1 else "1 state number"
    return (
        f"On this machine the policy {pace} the robot's {fps:g} a second; its largest jump is "
        f"{jumps.max():.2f} spreads, and {state} left the range it knows: no robot moved, so this "
        "says nothing about whether the task would be done."
    )
