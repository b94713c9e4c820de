"""A run whose decisions are made in many environments at once, its *lanes*.

    act in L lanes -> workers step and draw ......................... -> L transitions
                         meanwhile updates on what was there before

On a CPU the order of everything is fixed, so a run is a function of its configuration and seed and
of the learner's threads, whatever the number of workers. What learns, and how much, is a recipe's
own (``vectorised``, ``mv_mwm``).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

from madviz.agent.agent import TorchPolicy
from madviz.measure.store import EpisodeResult
from madviz.runs.reward_run import RewardRun, RunConfig
from madviz.runs.run_folder import RunFolder
from madviz.runs.training_plan import TrainingPlan
from madviz.runs.vector_envs import VectorEnvs
from madviz.system.numbers import Count, ThreadsOrNone, Weight
from madviz.types import Array, Environment


@dataclass(frozen=True)
class LanesConfig(RunConfig):
    """How many environments share the work."""

    environments: Count = 8
    """That step together; a decision of all of them counts as so many decisions."""
    workers: ThreadsOrNone | None = None
    """Processes that step them; 0: none but this one. By default one for every second core. With
    ``--threads`` given their number changes nothing but the time; else the learner takes the cores
    that they leave, and its number of threads makes another run."""
    update_ratio: Weight = 0.5
    """Updates per decision; the paper makes one for every second decision."""

    ONLY_TIME = (*RunConfig.ONLY_TIME, "workers")

    def processes(self) -> int:
        """Worker processes to start."""
        if self.workers is not None:
            return self.workers
        return min(self.environments, max(1, (os.cpu_count() or 1) // 2))

    def threads(self) -> int:
        """One for each core that no worker has."""
        return max(1, (os.cpu_count() or 1) - self.processes())


class LanesRun(RewardRun):
    """See the module. A recipe adds ``learn``."""

    config: LanesConfig

    def __init__(
        self,
        plan: TrainingPlan,
        config: LanesConfig,
        env: Environment,
        folder: RunFolder,
        envs: VectorEnvs,
    ) -> None:
        """``env`` records demonstrations, where a recipe has any."""
        super().__init__(plan, config, env, folder, lanes=config.environments)
        self.envs = envs

    def learn(self) -> None:
        """The updates that the decisions so far ask for."""
        raise NotImplementedError

    def advance(self) -> None:
        """A decision in every lane; updates that are due are made while the lanes take theirs."""
        lanes = range(self.envs.lanes)
        if self.between_episodes:
            self._begin()
        exploring = self.step < self.config.exploration_steps
        actions = self.explore(self.envs.lanes) if exploring else self.act()
        self.envs.send(actions)
        try:
            self.learn()
        finally:
            self.envs.receive()  # Whatever happened, no answer may be left in a pipe.
        board = self.envs.board
        last = bool(board["last"].all())
        discount = self.discount_of(last)
        for lane in lanes:
            reward, state = float(board["reward"][lane, 0]), board["state"][lane]
            self.buffer.add(actions[lane], reward, discount, state, self.envs.frames(lane))
        self.step += len(lanes)
        self.between_episodes = last

    def _begin(self) -> None:
        self.episode_seeds = self.draw_seeds(self.envs.lanes)
        self.episodes += self.envs.lanes
        self.envs.reset(self.episode_seeds)
        for lane in range(self.envs.lanes):
            self.buffer.begin(self.envs.board["state"][lane], self.envs.frames(lane))

    def play(
        self, policy: TorchPolicy, jobs: list[tuple[Array, int]], stop: Callable[[], bool]
    ) -> list[EpisodeResult]:
        return self.envs.play(policy, jobs, stop)

    def repeat(self, actions: Array) -> None:
        self.envs.repeat(self.episode_seeds, actions)
