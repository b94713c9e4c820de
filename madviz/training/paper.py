"""The paper recipe: MAD by reinforcement learning, with the paper's schedule and hyper-parameters.

    for step in 0, 1, 2, ... 499,999:                          an agent step is one decision
        from step 2,000 on, every second step: one full update on 256 transitions
        act: uniformly before step 2,000, then drawn from the policy on all streams
             (Singular Only, which never learns to act on all: on one of its streams)

That is 249,000 updates and, where a decision lasts two simulator steps (Meta-World), a million of
those. Every 25,000 *simulator* steps, in ManiSkill every 20,000 (the paper's words; its code counts
decisions), at the next end of an episode, 20 deterministic episodes are run on all streams and on
each alone. The networks learn on a CUDA device where there is one; the paper's float32 is
``--paper.precision float32``.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

from madviz.runs.drawn_task import newest_frames
from madviz.runs.loop import train_on
from madviz.runs.run_folder import RunFolder
from madviz.runs.training_plan import TrainingPlan
from madviz.system.numbers import Count
from madviz.training.reinforcement import ReinforcementConfig, ReinforcementRun
from madviz.types import Array


@dataclass(frozen=True)
class PaperConfig(ReinforcementConfig):
    """The paper's schedule: one environment, an update every second decision."""

    update_every: Count = 2
    """Decisions between updates."""


class PaperRun(ReinforcementRun):
    """One decision at a time."""

    SCHEDULE = "by the paper's schedule"
    config: PaperConfig

    def advance(self) -> None:
        """One decision, with the update that is due before it."""
        config, streams = self.config, self.plan.spec.streams
        exploring = self.step < config.exploration_steps
        if self.between_episodes:
            self.episode_seeds = self.draw_seeds(1)
            self.episodes += 1
            now = self.env.reset(self.episode_seeds[0])
            self.buffer.begin(now.state, newest_frames(self.env, streams))
        if not exploring and self.step % config.update_every == 0:
            self.losses = self.learner.update(self.buffer.sample(config.batch_size, self.rng))
            self.updates += 1
        action = self.explore() if exploring else self.act()[0]
        now = self.env.step(action)
        discount = self.discount_of(now.last)
        frames = newest_frames(self.env, streams)
        self.buffer.add(action, now.reward, discount, now.state, frames)
        self.step += 1
        self.between_episodes = now.last

    def repeat(self, actions: Array) -> None:
        self.env.reset(self.episode_seeds[0])
        for action in actions[:, 0]:
            self.env.step(action)


def train_paper(plan: TrainingPlan, config: PaperConfig, folder: RunFolder) -> None:
    """Trains by the paper's recipe, from the folder's last state on if it has one.

    Ctrl-C saves after the decision (or evaluation episode) at hand. Raises UserError for what the
    machine cannot do.
    """
    with closing(plan.drawn_task.build()) as env:
        train_on(PaperRun(plan, config, env, folder))
