"""A run of reinforcement learning: what is learned, what was seen, and where the run stands.

What all recipes share is here: their numbers, the learner and its buffer, evaluation, and state to
go on from. How decisions and updates alternate is a recipe's own (``paper``, ``vectorised``); the
loop around them is ``loop.train_on``.

Discount, evaluations and time limits are the paper's for the task at hand: they differ between
its two suites (``SuiteNumbers``). Where an option says otherwise, the option counts. Every reset
draws a new scene, of 2,146 million.

A run is a function of its plan and configuration. Resume state holds weights, optimisers,
generators and what is new in the buffer; a killed run goes on in mid-episode, by resetting to the
episode's seed and repeating its actions, and ends with the weights of a run that was left alone.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.update import generator_state, restore_generator
from madviz.errors import UserError
from madviz.measure.episodes import one_thread, run_episode
from madviz.measure.store import EpisodeResult
from madviz.observation.ablation import Ablation
from madviz.policies.config import TrainingRecord
from madviz.policies.seeds import FIRST_LEARNING, FIRST_SELECTION
from madviz.runs.buffer import BufferSpec, ReplayBuffer
from madviz.runs.recipe_options import RecipeOptions
from madviz.runs.run_folder import RunFolder
from madviz.runs.training_plan import TrainingPlan
from madviz.subsets import mask_of, single_streams
from madviz.system.numbers import CountOrNone, Share, Steps, Width
from madviz.types import Array, Environment


@dataclass(frozen=True)
class SuiteNumbers:
    """What the paper has differently for its two suites; time limits are as in its code."""

    discount: float
    eval_every: int
    """Simulator steps."""
    bootstraps: bool
    """Whether the last step of an episode still expects a future."""


METAWORLD, MANISKILL = SuiteNumbers(0.99, 25_000, True), SuiteNumbers(0.8, 20_000, False)


@dataclass(frozen=True)
class RunConfig(RecipeOptions):
    """What every recipe that learns from rewards has, whatever it learns."""

    steps: Steps = 500_000
    """Decisions in the whole run."""
    exploration_steps: Steps = 2_000
    """Decisions drawn uniformly before the policy acts; no update of it before that."""
    batch_size: Width = 256
    """Transitions in an update."""
    buffer_capacity: Steps = 500_000
    """Transitions that are remembered."""
    buffer_packed: bool = True
    """Pack frames in memory without loss: a quarter of the bytes; every batch is the same."""
    buffer_on_disk: bool = False
    """Keep frames, as they are, in files of the run's folder; memory need not hold them."""
    discount: Share | None = None
    """Gamma; by default 0.99, and 0.8 for ManiSkill."""
    time_limit: Literal["suite", "goes-on", "ends"] = "suite"
    """Whether the last step of an episode still expects a future, as nothing really ends there; by
    default it does, and in ManiSkill its reward is all."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the networks learn; ``auto`` takes CUDA where there is one."""
    eval_every: Steps | None = None
    """Simulator steps between evaluations; by default 25000, and 20000 for ManiSkill."""
    eval_episodes: CountOrNone = 20
    """Deterministic episodes for each subset; 0: none, and no success in the curve."""
    save_every: Steps = 2_000
    """Decisions between checkpoints."""

    ONLY_TIME = ("buffer_packed", "buffer_on_disk", "save_every")

    def numbers_of(self, task: str) -> SuiteNumbers:
        """The paper's for ``task``, but where an option says otherwise."""
        suite = MANISKILL if task.startswith("maniskill/") else METAWORLD
        return SuiteNumbers(
            suite.discount if self.discount is None else self.discount,
            suite.eval_every if self.eval_every is None else self.eval_every,
            suite.bootstraps if self.time_limit == "suite" else self.time_limit == "goes-on",
        )

    def torch_device(self) -> str:
        """Raises UserError where CUDA is asked for and not there."""
        there = torch.cuda.is_available()
        if self.device == "cuda" and not there:
            raise UserError(
                "expected a CUDA device for the option device = cuda, found none that PyTorch can "
                "use; see `nvidia-smi`, or leave the option out"
            )
        return "cuda" if there and self.device != "cpu" else "cpu"

    def frames_device(self) -> str:
        """In whose memory the buffer's frames are."""
        return "cpu"


class LearnsByRun(Protocol):
    """What a run needs of whatever learns in it."""

    agent: Agent

    def act_all(self, views: Tensor, state: Tensor) -> Array:
        """(L, V, C, H, W) uint8 and (L, S) to drawn actions (L, A)."""
        ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


class RewardRun:
    """One run: learner, buffer, environment, and where they stand. A recipe adds what learns, and
    ``advance``."""

    SCHEDULE: str
    """How decisions and updates alternate, for the card."""
    LOSSES: tuple[str, ...]
    """The columns of the curve that are not success."""
    config: RunConfig

    def __init__(
        self,
        plan: TrainingPlan,
        config: RunConfig,
        env: Environment,
        folder: RunFolder,
        lanes: int = 1,
    ) -> None:
        """``env`` is what ``plan.drawn_task`` builds; ``lanes`` environments fill the buffer in
        turn. Raises UserError if the buffer will not fit, and for a device that is not there."""
        self.plan, self.config, self.env, self.folder = plan, config, env, folder
        self.numbers = config.numbers_of(plan.spec.task)
        self.learner = self.new_learner()
        where = config.frames_device()
        self.buffer = ReplayBuffer(
            BufferSpec(
                plan.spec.streams,
                state_dim=plan.env.state_dim,
                action_dim=plan.env.action_dim,
                capacity=min(config.buffer_capacity, config.steps),
                horizon=plan.env.horizon,
                frame_stack=plan.spec.frame_stack,
                packed=config.buffer_packed and not config.buffer_on_disk and where == "cpu",
                lanes=lanes,
            ),
            folder.resume / "frames" if config.buffer_on_disk else None,
            device=where,
        )
        self.rng = np.random.default_rng(plan.seed)
        self.step = self.updates = self.episodes = self.evaluate_at = 0
        self.evaluated_step = -1
        self.seconds = self.busy = 0.0
        self.losses: dict[str, float] = {}
        self.between_episodes = True
        self.episode_seeds: list[int] = []

    def new_learner(self) -> LearnsByRun:
        """Before its first update."""
        raise NotImplementedError

    def advance(self) -> None:
        """The next decisions, with the updates that are due."""
        raise NotImplementedError

    def record(self) -> TrainingRecord:
        """How the policy came about, as far as all recipes say it alike."""
        on_cuda = self.config.torch_device() == "cuda"
        return TrainingRecord(
            how=f"reinforcement learning from scratch, {self.SCHEDULE}",
            command=self.plan.command,
            steps=self.step,
            environment_steps=self.env_steps,
            episodes=self.episodes,
            updates=self.updates,
            batch_size=self.config.batch_size,
            seeds=f"network and data {self.plan.seed}, episodes from {FIRST_LEARNING} on",
            wall_time_s=round(self.seconds),
            finished=self.finished,
            device=torch.cuda.get_device_name() if on_cuda else None,
        )

    @property
    def env_steps(self) -> int:
        """Simulator steps taken."""
        return self.step * self.plan.env.action_repeat

    @property
    def finished(self) -> bool:
        return self.step >= self.config.steps

    def evaluation_due(self) -> bool:
        """At the start, at the first episode's end past every ``eval_every``, and at the end."""
        regular = self.between_episodes and self.env_steps >= self.evaluate_at
        return regular or (self.finished and self.evaluated_step != self.step)

    def evaluate(self, stop: Callable[[], bool]) -> dict[str, float]:
        """Success and return on all streams and on each alone, where the policy supports it.
        Raises Stopped if ``stop`` says so.

        The environment is between two episodes; the next one begins with a reset anyway.
        """
        policy, streams, count = self.policy(), self.plan.spec.streams, self.config.eval_episodes
        masks = {
            subset: mask_of(subset, streams)
            for subset in dict.fromkeys(("all", *single_streams(streams)))
        }
        asked = [subset for subset in masks if count and policy.supports(masks[subset])]
        seeds = range(FIRST_SELECTION, FIRST_SELECTION + count)
        results = iter(self.play(policy, [(masks[s], seed) for s in asked for seed in seeds], stop))
        row: dict[str, float] = {}
        for subset in asked:
            of = [next(results) for _ in seeds]
            row[f"success_{subset}"] = round(float(np.mean([r.success for r in of])), 4)
            row[f"return_{subset}"] = round(float(np.mean([r.total_reward for r in of])), 3)
        self.evaluated_step = self.step
        every = self.numbers.eval_every
        self.evaluate_at = (self.env_steps // every + 1) * every
        return row

    def play(
        self, policy: TorchPolicy, jobs: list[tuple[Array, int]], stop: Callable[[], bool]
    ) -> list[EpisodeResult]:
        """An episode for each of ``jobs``: a mask (V,) and a seed. Raises Stopped if ``stop`` says
        so."""
        with one_thread():
            return [run_episode(policy, self.env, mask, Ablation(), s, stop) for mask, s in jobs]

    def policy(self) -> TorchPolicy:
        """What is evaluated."""
        return TorchPolicy(self.plan.spec, self.acting_agent())

    def acting_agent(self) -> Agent:
        """The agent where policies compute and are saved, which is the CPU."""
        agent = self.learner.agent
        on_cpu = agent.log_temperature.device.type == "cpu"
        return agent if on_cpu else copy.deepcopy(agent).cpu()

    def state(self) -> dict[str, Any]:
        """Everything ``restore`` needs; what is new in the buffer is written on the way."""
        return {
            "learner": self.learner.state_dict(),
            "buffer": self.buffer.save(self.folder.resume / "buffer"),
            "rng": generator_state(self.rng),
            **{key: getattr(self, key) for key in _COUNTS},
        }

    def saved(self) -> None:
        """The newest ``state`` is in its place: what only older ones needed goes."""
        self.buffer.remove_other_parts(self.folder.resume / "buffer")

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from ``state``, in mid-episode if need be."""
        self.learner.load_state_dict(state["learner"])
        self.buffer.restore(self.folder.resume / "buffer", state["buffer"])
        restore_generator(self.rng, state["rng"])
        for key in _COUNTS:
            setattr(self, key, state[key])
        if not self.between_episodes:
            self.repeat(self.buffer.actions())

    def repeat(self, actions: Array) -> None:
        """Puts the running episodes where ``actions`` (age, L, A) led them."""
        raise NotImplementedError

    def draw_seeds(self, lanes: int) -> list[int]:
        """Of the next training episodes: new scenes at every reset."""
        return self.rng.integers(FIRST_LEARNING, 2**31, lanes).tolist()

    def discount_of(self, last: bool) -> float:
        """What is stored with a decision; ``last`` of its episode."""
        return 0.0 if last and not self.numbers.bootstraps else self.numbers.discount

    def explore(self, *lanes: int) -> Array:
        """(*lanes, A) uniform actions."""
        size = (*lanes, self.plan.env.action_dim)
        return self.rng.uniform(-1, 1, size).astype(np.float32)

    def act(self) -> Array:
        """(L, A): what the policy draws in every lane."""
        return self.learner.act_all(*self.buffer.newest())


_COUNTS = (
    "step",
    "updates",
    "episodes",
    "evaluate_at",
    "evaluated_step",
    "seconds",
    "losses",
    "between_episodes",
    "episode_seeds",
)
