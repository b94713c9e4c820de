"""A part of the tests that runs here, in LeRobot's own environment.

    .venv/bin/python check_metaworld.py OUT.npz TASK SEED...

Writes what LeRobot's own Meta-World shows: by seed, actions that are drawn from it, the states of
all steps, and the pictures of those in ``drawn``, of which 0 is right after the reset.
"""

from __future__ import annotations

import sys

import numpy as np
from lerobot.envs.metaworld import MetaworldEnv

STEPS = 20
DRAWN = (0, 12)


def actions(seed: int) -> np.ndarray:
    """(STEPS, 4) float32 in [-1, 1], which go somewhere."""
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(-1, 1, 4) + rng.normal(0, 0.3, (STEPS, 4))
    return np.clip(drawn, -1, 1).astype(np.float32)


def main(out: str, task: str, seeds: list[int]) -> None:
    env = MetaworldEnv(f"{task}-v3", obs_type="pixels_agent_pos")
    states = []
    pictures = []
    for seed in seeds:
        seen, _ = env.reset(seed=seed)
        states.append([seen["agent_pos"]])
        pictures.append([seen["pixels"]])
        for step, action in enumerate(actions(seed), 1):
            if step in DRAWN:
                seen, *_ = env.step(action)
                pictures[-1].append(seen["pixels"])
                states[-1].append(seen["agent_pos"])
            else:  # The same step without a picture, which takes most of the time.
                assert env._env is not None
                observation, *_ = env._env.step(action)
                states[-1].append(observation[:4])
    acted = [actions(seed) for seed in seeds]
    np.savez_compressed(out, actions=acted, states=states, pictures=pictures, drawn=DRAWN)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], [int(word) for word in sys.argv[3:]])
