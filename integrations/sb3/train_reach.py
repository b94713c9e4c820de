"""Trains PPO of Stable-Baselines3 on madviz's toy, from pictures, on a CPU.

    python train_reach.py --out ppo-reach.zip
    madviz explore --policy sb3:ppo-reach.zip@toy/reach --trust
    madviz audit --policy sb3:ppo-reach.zip@toy/reach --trust --how black --out audit-ppo

In madviz's own environment, with ``pip install "madviz[sb3]"``. 40,000 decisions take two minutes
on two cores. The policy of seed 0 then succeeds in 1.00 [0.96, 1.00] of 100 episodes (seeds 10000
to 10099); docs/audit.md has its audit.
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import madviz  # noqa: F401 - It tells Gymnasium of its tasks.


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="ppo-reach.zip")
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--size", type=int, default=48, help="pixels of a picture")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    options = {"flat": True, "depth": False, "size": asked.size}
    envs = make_vec_env("madviz/reach-v0", n_envs=8, seed=0, env_kwargs=options)
    model = PPO(
        "MultiInputPolicy",
        envs,
        learning_rate=5e-4,
        n_steps=100,
        batch_size=100,
        n_epochs=4,
        gamma=0.9,
        seed=0,
        policy_kwargs={
            "normalize_images": True,
            "log_std_init": -0.7,
            "features_extractor_kwargs": {"cnn_output_dim": 64},
        },
        verbose=1,
    )
    model.learn(asked.steps)
    model.save(asked.out)
    fresh = gymnasium.make("madviz/reach-v0", **options)
    print("mean return of 20 episodes:", evaluate_policy(model, fresh, 20)[0])


if __name__ == "__main__":
    main()
