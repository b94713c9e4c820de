"""Plays the script of a task of madviz, and writes its episodes by LeRobot's own writer.

    .venv/bin/python write_recordings.py metaworld/hammer hammer-films

gives a LeRobotDataset of 50 episodes from seed 0 on, with films of 240 x 320 pixels in LeRobot's
own choice of codec (AV1), as a robot's recordings have them. madviz's cameras see a square; it is
stretched to the film, as ``stretch = true`` does in a wire file.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from madviz.envs.checks import expert_action
from madviz.envs.registry import make_env
from madviz.types import Environment

SIZE = 240, 320
FPS = 10
PICTURE = "observation.images"


def features(env: Environment) -> dict[str, dict]:
    """LeRobot's description of what an episode holds."""
    film = {"dtype": "video", "shape": (*SIZE, 3), "names": ["height", "width", "channels"]}
    widths = {"observation.state": env.spec.state_dim, "action": env.spec.action_dim}
    numbers = {
        key: {"dtype": "float32", "shape": (width,), "names": [f"{n}" for n in range(width)]}
        for key, width in widths.items()
    }
    return {f"{PICTURE}.{camera.name}": film for camera in env.spec.cameras} | numbers


def decisions(env: Environment, seed: int) -> Iterator[dict]:
    """Yields each decision of an episode: a picture (H, W, 3) uint8 of every camera, the state
    (S,), the script's action (A,) and the task in words."""
    now = env.reset(seed)
    while True:
        views = {camera.name: env.view(camera.name, max(SIZE)).rgb for camera in env.spec.cameras}
        action = expert_action(env)
        yield {
            **{f"{PICTURE}.{name}": stretched(view) for name, view in views.items()},
            "observation.state": np.asarray(now.state, np.float32),
            "action": np.asarray(action, np.float32),
            "task": env.spec.instruction or env.spec.task,
        }
        now = env.step(action)
        if now.last:
            return


def stretched(view: np.ndarray) -> np.ndarray:
    """(S, S, 3) uint8 -> (H, W, 3), ``SIZE`` being H and W."""
    return cv2.resize(view, SIZE[::-1], interpolation=cv2.INTER_AREA)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", help="of madviz list")
    parser.add_argument("out", type=Path, help="a new folder")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0, help="of the first episode")
    asked = parser.parse_args()
    env = make_env(asked.task)
    dataset = LeRobotDataset.create("madviz/films", FPS, features(env), root=asked.out)
    for episode in range(asked.episodes):
        for decision in decisions(env, asked.seed + episode):
            dataset.add_frame(decision)
        dataset.save_episode()
        print(f"episode {episode + 1} of {asked.episodes}", flush=True)
    dataset.finalize()


if __name__ == "__main__":
    main()
