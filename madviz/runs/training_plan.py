"""A training with nothing left to choose: what every recipe is given.

``config.resolve`` makes a ``TrainingPlan`` of the user's options, once; no recipe sees the options
of another one, and nothing after it chooses cameras, streams or networks.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from madviz.agent.agent import Agent
from madviz.agent.methods import Method, method
from madviz.agent.networks import NetworkConfig
from madviz.policies.checkpoint import save_policy
from madviz.policies.config import TrainingRecord, policy_config
from madviz.runs.drawn_task import DrawnTask
from madviz.runs.run_folder import RunFolder
from madviz.types import EnvSpec, PolicySpec


@dataclass(frozen=True)
class TrainingPlan:
    """The policy to train, its task, and its name."""

    spec: PolicySpec
    """The trained policy's own description: name, method, streams, trained subsets."""
    drawn_task: DrawnTask
    env: EnvSpec
    """The facts of an environment that ``drawn_task`` builds."""
    networks: NetworkConfig
    merge: str
    """How streams become one feature: a row of ``MERGES``."""
    seed: int
    camera: str = ""
    """The one camera of a method that takes one; empty for all others."""
    command: str = ""
    """The line that trains this policy again."""

    @property
    def method(self) -> Method:
        """Which subsets are trained, and how much each weighs."""
        return method(self.spec.method)

    def new_agent(self, temperature: float = 0.1) -> Agent:
        """The networks as they are before the first update: a function of the seed."""
        torch.manual_seed(self.seed)
        return Agent(self.networks, temperature, self.merge, self.spec.streams)

    def save(
        self, folder: RunFolder, agent: Agent, record: TrainingRecord, reward_scale: float = 1.0
    ) -> None:
        """Writes ``agent`` as a policy in its shipped form, with how it came about."""
        described = policy_config(
            self.spec,
            self.env,
            agent.config,
            record,
            merge=agent.merge_name,
            camera=self.camera,
            reward_scale=reward_scale,
        )
        save_policy(folder.path, agent, described)
