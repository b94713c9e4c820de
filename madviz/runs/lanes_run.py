"""A run whose decisions are made in many environments at once, its *lanes*.

    act in L lanes -> workers step and draw ......................... -> L transitions
                         meanwhile updates on what was there before

On a CPU the order of everything is fixed, so a run is a function of its configuration and seed and
of the learner's threads, whatever the number of workers. What learns, and how much, is a recipe's
own (``vectorised``, ``world_model/recipe.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

from madviz.agent.agent import TorchPolicy
from madviz.errors import UserError
from madviz.policies.config import TrainingRecord
from madviz.runs.recipe_options import RunConfig
from madviz.runs.reward_run import RewardRun
from madviz.runs.training_plan import TrainingPlan
from madviz.runs.vector_envs import Board, VectorEnvs
from madviz.system.machine import cores
from madviz.system.numbers import Count, ThreadsOrNone, Weight
from madviz.types import Array


@dataclass(frozen=True)
class LanesConfig(RunConfig):
    """How many environments share the work."""

    environments: Count = 8
    """That step together; a decision of all of them counts as so many decisions."""
    workers: ThreadsOrNone | None = None
    """Processes that step them; 0: none but this one. By default one for every eighth core where
    updates take the CPU, and one for all cores but one where they take a CUDA device. With
    ``--threads`` given their number changes nothing but the time; else the learner takes the cores
    that they leave, on two cores both, and its number of threads makes another run."""
    update_ratio: Weight = 0.5
    """Updates per decision; the paper makes one for every second decision."""

    ONLY_TIME = (*RunConfig.ONLY_TIME, "workers")

    def processes(self) -> int:
        """Worker processes to start. On a CPU an update of 256 takes as long as 32 steps of
        push-cube, and one is made for every second step: a worker in eight cores keeps up. Beside a
        CUDA device steps are what takes long."""
        if self.workers is not None:
            return self.workers
        spare = cores() - 1 if self.torch_device() == "cuda" else cores() // 8
        return min(self.environments, max(1, spare))

    def threads(self) -> int:
        """One for each core that no worker has. On two cores both: updates take far longer than
        steps there, so the one worker waits most of the time."""
        return cores() if cores() <= 2 else max(1, cores() - self.processes())


@contextmanager
def lanes_of(plan: TrainingPlan, config: LanesConfig) -> Iterator[VectorEnvs]:
    """The environments of a run, until it is over."""
    facts = plan.env
    lanes = config.environments
    board = Board(lanes, plan.spec.streams, facts.state_dim, facts.action_dim)
    with closing(VectorEnvs(plan.drawn_task, board, lanes, config.processes())) as envs:
        yield envs


def train_in_lanes(
    run: RewardRun[Any, Any],
    envs: VectorEnvs,
    act: Callable[[], Array],
    learn: Callable[[], None],
    policy: Callable[[], TorchPolicy],
    record: Callable[[], TrainingRecord],
) -> None:
    """Trains from the folder's last state, if it has one, to the end of the run or a Ctrl-C.

    ``act`` gives the actions (L, A) of all lanes, ``learn`` makes the updates that are due,
    ``policy`` is evaluated, and ``record`` says how it came about.
    """
    run.resume(envs.repeat)
    run.train(policy, envs.play, record, lambda: advance(run, envs, act, learn))


def advance(
    run: RewardRun[Any, Any],
    envs: VectorEnvs,
    act: Callable[[], Array],
    learn: Callable[[], None],
) -> None:
    """A decision in every lane; updates that are due are made while the lanes take theirs."""
    lanes = range(envs.lanes)
    if run.between_episodes:
        run.episode_seeds = run.draw_seeds(envs.lanes)
        run.episodes += envs.lanes
        envs.reset(run.episode_seeds)
        for lane in lanes:
            run.buffer.begin(envs.board["state"][lane], envs.frames(lane))
    actions = run.explore(envs.lanes) if run.exploring else act()  # (L, A)
    envs.send(actions)
    try:
        learn()
    finally:
        envs.receive()  # Whatever happened, no answer may be left in a pipe.
    ended = envs.board["last"]
    last = bool(ended.all())
    if ended.any() and not last:
        raise UserError(
            f"expected episodes of {run.plan.env.task} that are equally long, found one that ended "
            "before the others; make them so, or take a method with the recipe paper"
        )
    discount = run.discount_of(last)
    for lane in lanes:
        reward = float(envs.board["reward"][lane])
        state = envs.board["state"][lane]
        run.buffer.add(actions[lane], reward, discount, state, envs.frames(lane))
    run.step += envs.lanes
    run.between_episodes = last
