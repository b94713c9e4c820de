"""The actions of recorded episodes, and the same episodes played again from them.

The episodes of a training have 0.6 GB and stay on the machine that recorded them; their actions
have 0.2 MB. Scene, states, rewards and the expert's labels follow from seed and actions. So another
machine makes the same episodes again, and rewards show whether they are the same; pictures may
differ by single brightness values, where its processor draws otherwise.

    keep(run, folder)           writes config.json and actions.npz
    play_again(folder, run)     makes the episodes of a run that kept its own
"""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path

import numpy as np

from madviz.envs.registry import make_env
from madviz.measure.episodes import one_thread
from madviz.policies.checkpoint import CONFIG
from madviz.policies.config import PolicyConfig, read_config
from madviz.policies.seeds import training_seed
from madviz.runs.demonstrations import Driver, Episode, record_episode
from madviz.training.kept_episodes import FOLDER, episode_files
from madviz.types import Array, Encoded, Readout

ACTIONS = "actions.npz"
TOLERANCE = 1e-4
"""A reward is at most 10; two that differ by more than this are of different episodes."""


class _Repeats:
    """Acts as an episode did, in place of a student."""

    def __init__(self, config: PolicyConfig, actions: Array) -> None:
        """``actions`` (T, A)."""
        self.spec = config.spec("")
        self._left = iter(actions)

    def encode(self, views: Array, state: Array) -> Encoded:
        return Encoded(np.zeros((len(views), 0)), state)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        nothing = np.zeros((1, 0))
        return Readout(nothing, next(self._left)[None], np.full(1, np.nan))

    def supports(self, mask: Array) -> bool:
        return True


def keep(run: Path, folder: Path) -> None:
    """Writes the actions of the episodes that ``run`` kept, with its configuration."""
    rounds, episodes = [], []
    for number, files in sorted(episode_files(run / FOLDER).items()):
        rounds += [number] * len(files)
        episodes += [Episode.load(file) for file in files]
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(run / CONFIG, folder / CONFIG)
    np.savez_compressed(
        folder / ACTIONS,
        rounds=rounds,
        actions=np.stack([episode.actions for episode in episodes]),  # (N, T, A)
        rewards=np.stack([episode.rewards for episode in episodes]),  # (N, T)
    )


def play_again(folder: Path, run: Path, seed: int) -> None:
    """Makes ``run`` a folder with kept episodes: those of ``folder``, of a training with ``seed``.
    Raises ValueError where a reward is another one."""
    config, _ = read_config(folder / CONFIG)
    with np.load(folder / ACTIONS, allow_pickle=False) as archive:
        rounds, actions, rewards = (archive[name] for name in ("rounds", "actions", "rewards"))
    (run / FOLDER).mkdir(parents=True, exist_ok=True)
    everything = np.ones(len(config.streams), bool)
    with closing(make_env(config.task, config.render_profile, config.cameras)) as env, one_thread():
        for number, done in enumerate(actions):
            again = Driver(0.0, 0.0, _Repeats(config, done), everything)
            at = training_seed(seed, number)
            episode = record_episode(env, config.streams, again, at)
            apart = float(np.abs(episode.rewards - rewards[number]).max())
            if apart > TOLERANCE:
                raise ValueError(f"episode {number} of {folder}: a reward differs by {apart:.2g}")
            place = int(np.sum(rounds[:number] == rounds[number]))
            episode.save(run / FOLDER / f"{rounds[number]:03d}-{place:02d}.npz")
    shutil.copy(folder / CONFIG, run / CONFIG)  # Last: a folder without it is not complete.
