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
from typing import TypeVar

import numpy as np
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.augment import random_shift
from madviz.agent.sizes import NetworkConfig
from madviz.agent.update import Learner, LearningConfig
from madviz.errors import UserError
from madviz.measure.episodes import one_thread, run_episode
from madviz.measure.store import EpisodeResult
from madviz.observation.ablation import Ablation
from madviz.runs.drawn_task import newest_frames
from madviz.runs.recipe_options import RunConfig
from madviz.runs.reward_run import Play, RewardRun, Stop
from madviz.runs.run_folder import RunFolder
from madviz.runs.training_plan import TrainingPlan
from madviz.system.numbers import Count, Rate, Width
from madviz.types import Array, Encoded, Environment, EnvSpec, PolicySpec

HOW = "reinforcement learning from scratch, by the paper's schedule"


@dataclass(frozen=True)
class ReinforcementConfig(LearningConfig, RunConfig):
    """Options of all recipes with the paper's losses; the defaults are the paper's numbers."""

    hidden_dim: Width = 1024
    """Width of the heads' hidden layers."""
    temperature: Rate = 0.1
    """Weight of the entropy bonus at the start; learned from then on."""
    shift_when_acting: bool = False
    """Also shift what the policy acts on, in training and in evaluations while it trains (as the
    code does, in all evaluations). The policy that is saved does not."""
    buffer_on_host: bool = False
    """Keep frames in the computer's memory although the networks learn on a CUDA device.
    Otherwise they are in the device's, unpacked."""

    ONLY_TIME = (*RunConfig.ONLY_TIME, "buffer_on_host")

    def networks(self, env: EnvSpec, state_columns: tuple[int, ...]) -> NetworkConfig:
        return NetworkConfig(
            env.state_dim,
            env.action_dim,
            hidden_dim=self.hidden_dim,
            state_columns=state_columns,
        )

    def frames_device(self) -> str:
        return "cpu" if self.buffer_on_host or self.buffer_on_disk else self.torch_device()


Reinforcement = TypeVar("Reinforcement", bound=ReinforcementConfig)


@dataclass(frozen=True)
class PaperConfig(ReinforcementConfig):
    """The paper's schedule: one environment, an update every second decision."""

    update_every: Count = 2
    """Decisions between updates."""


def train_paper(plan: TrainingPlan, config: PaperConfig, folder: RunFolder) -> None:
    """Trains by the paper's recipe, from the folder's last state on if it has one. Raises UserError
    for what the machine cannot do."""
    with closing(plan.drawn_task.build()) as env:
        run = new_run(plan, config, folder)
        run.resume(lambda seeds, actions: repeat(env, seeds, actions))
        run.train(
            policy=lambda: evaluated(run),
            play=player(env),
            record=lambda: run.record(HOW),
            advance=lambda: advance(run, env),
        )


def advance(run: RewardRun[Learner, PaperConfig], env: Environment) -> None:
    """One decision, with the update that is due before it."""
    streams = run.plan.spec.streams
    if run.between_episodes:
        run.episode_seeds = run.draw_seeds(1)
        run.episodes += 1
        now = env.reset(run.episode_seeds[0])
        run.buffer.begin(now.state, newest_frames(env, streams))
    if not run.exploring and run.step % run.config.update_every == 0:
        run.losses = run.learner.update(run.buffer.sample(run.config.batch_size, run.rng))
        run.updates += 1
    action = run.explore() if run.exploring else act(run)[0]  # (A,)
    now = env.step(action)
    discount = run.discount_of(now.last)
    run.buffer.add(action, now.reward, discount, now.state, newest_frames(env, streams))
    run.step += 1
    run.between_episodes = now.last


def new_run(
    plan: TrainingPlan, config: Reinforcement, folder: RunFolder, lanes: int = 1
) -> RewardRun[Learner, Reinforcement]:
    """A run with the paper's losses, before its first decision."""
    agent = plan.new_agent(config.temperature).to(config.torch_device())
    learner = Learner(agent, plan.method, plan.spec.streams, config, plan.seed)
    return RewardRun(plan, config, folder, learner, lanes)


def act(run: RewardRun[Learner, Reinforcement]) -> Array:
    """(L, A): what the policy draws in every lane."""
    views, state = run.buffer.newest()  # (L, V, C, H, W), (L, S)
    if run.config.shift_when_acting:
        views = random_shift(views, run.rng, run.config.same_shift_for_views)
    action = run.learner.act_all(views, state)
    if not np.isfinite(action).all():
        raise UserError(
            f"expected finite actions, found NaN or infinity after {run.updates} updates; the "
            "training diverged: begin again with a smaller learning rate"
        )
    return action


def evaluated(run: RewardRun[Learner, Reinforcement]) -> TorchPolicy:
    """The policy that is evaluated."""
    spec = run.plan.spec
    agent = run.acting_agent()
    if run.config.shift_when_acting:
        return ShiftingPolicy(spec, agent, run.config.same_shift_for_views)
    return TorchPolicy(spec, agent)


def player(env: Environment) -> Play:
    """Plays evaluations in ``env``, one episode after the other."""

    def play(policy: TorchPolicy, jobs: list[tuple[Array, int]], stop: Stop) -> list[EpisodeResult]:
        with one_thread():
            return [run_episode(policy, env, mask, Ablation(), seed, stop) for mask, seed in jobs]

    return play


def repeat(env: Environment, seeds: list[int], actions: Array) -> None:
    """Puts the running episode where ``actions`` (age, 1, A) led it."""
    env.reset(seeds[0])
    for action in actions[:, 0]:
        env.step(action)


class ShiftingPolicy(TorchPolicy):
    """The code's policy, in evaluations while it trains: every view it acts on is shifted.
    ``same``: all views of a time step by the same pixels."""

    def __init__(self, spec: PolicySpec, agent: Agent, same: bool) -> None:
        super().__init__(spec, agent)
        self._same = same

    def encode(self, views: Array, state: Array) -> Encoded:
        return super().encode(self._moved(views), state)

    def act_together(self, views: Array, state: Array, masks: Array) -> Array:
        moved = np.stack([self._moved(each) for each in views])
        return super().act_together(moved, state, masks)

    def _moved(self, views: Array) -> Array:
        """(V, C, H, W), by pixels drawn from the pictures themselves, so that an episode stays a
        function of its seed."""
        rng = np.random.default_rng(int(views.sum(dtype=np.int64)))
        moved = random_shift(torch.from_numpy(views)[None], rng, self._same)
        return moved[0].numpy()
