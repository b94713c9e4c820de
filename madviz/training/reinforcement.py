"""Runs with the paper's losses: their options, and what learns in them.

How decisions and updates alternate is a recipe's own (``paper``, ``vectorised``); what runs of all
recipes that learn from rewards share is in ``reward_run``.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.augment import random_shift
from madviz.agent.networks import NetworkConfig
from madviz.agent.update import LOSSES, Learner, LearningConfig
from madviz.policies.config import TrainingRecord
from madviz.runs.reward_run import RewardRun, RunConfig
from madviz.system.numbers import Rate, Width
from madviz.types import Array, Encoded, EnvSpec, PolicySpec


@dataclass(frozen=True)
class ReinforcementConfig(LearningConfig, RunConfig):
    """What the recipes with the paper's losses have; the defaults are the paper's numbers."""

    hidden_dim: Width = 1024
    """Width of the heads' hidden layers."""
    temperature: Rate = 0.1
    """Weight of the entropy bonus at the start; learned from then on."""
    shift_when_acting: bool = False
    """Also shift what the policy acts on, in training and in evaluations while it trains (as the
    code does, in all evaluations). The policy that is saved does not."""
    buffer_on_host: bool = False
    """Where the networks learn on a CUDA device: keep frames in the computer's memory all the same.
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


class ReinforcementRun(RewardRun):
    """A run with the paper's losses."""

    LOSSES = LOSSES
    config: ReinforcementConfig
    learner: Learner

    def new_learner(self) -> Learner:
        plan, config = self.plan, self.config
        agent = plan.new_agent(config.temperature).to(config.torch_device())
        return Learner(agent, plan.method, plan.spec.streams, config, plan.seed)

    def record(self) -> TrainingRecord:
        alpha = self.plan.method.alpha_of(self.config.alpha)
        return msgspec.structs.replace(super().record(), alpha=alpha)

    def policy(self) -> TorchPolicy:
        spec, agent = self.plan.spec, self.acting_agent()
        if self.config.shift_when_acting:
            return _ShiftingPolicy(spec, agent, self.config.same_shift_for_views)
        return TorchPolicy(spec, agent)

    def act(self) -> Array:
        views, state = self.buffer.newest()
        if self.config.shift_when_acting:
            views = random_shift(views, self.rng, self.config.same_shift_for_views)
        return self.learner.act_all(views, state)


class _ShiftingPolicy(TorchPolicy):
    """The code's policy, in evaluations while it trains: every view it acts on is shifted.
    ``same``: all views of a time step by the same pixels."""

    def __init__(self, spec: PolicySpec, agent: Agent, same: bool) -> None:
        super().__init__(spec, agent)
        self._same = same

    def encode(self, views: Array, state: Array) -> Encoded:
        # Drawn from the picture itself, so that an episode stays a function of its seed.
        rng = np.random.default_rng(int(views.sum(dtype=np.int64)))
        moved = random_shift(torch.from_numpy(views)[None], rng, self._same)
        return super().encode(moved[0].numpy(), state)
