"""A run of reinforcement learning: what is learned, what was seen, and where the run stands.

What all recipes share is here: the loop, evaluation, checkpoints, progress, and state to go on
from. How decisions and updates alternate is a recipe's own (``paper``, ``lanes_run``). Every reset
draws a new scene, of 2,146 million.

A run is a function of its plan and configuration. Resume state holds weights, optimisers,
generators and what is new in the buffer; a killed run goes on in mid-episode, by resetting to the
episode's seed and repeating its actions, and ends with the weights of a run that was left alone.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.update import generator_state, restore_generator
from madviz.errors import UserError
from madviz.measure.episodes import Stopped
from madviz.measure.store import EpisodeResult
from madviz.policies.config import TrainingRecord
from madviz.policies.seeds import FIRST_LEARNING, FIRST_SELECTION
from madviz.runs.buffer import BufferSpec, ReplayBuffer
from madviz.runs.curve import draw_curve
from madviz.runs.recipe_options import RunConfig
from madviz.runs.run_folder import RunFolder, interruptible
from madviz.runs.training_plan import TrainingPlan
from madviz.subsets import mask_of, single_streams
from madviz.types import Array

PROGRESS_SECONDS = 20
"""Seconds between lines that say how far a run is."""
Stop = Callable[[], bool]
Play = Callable[[TorchPolicy, list[tuple[Array, int]], Stop], list[EpisodeResult]]
"""Plays an episode of a policy for each of some masks (V,) and seeds. Raises Stopped if it is told
to stop."""


class LearnsByRun(Protocol):
    """The learner of a run, as the run sees it."""

    agent: Agent
    loss_names: ClassVar[tuple[str, ...]]
    """The columns of the curve that are not success."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


Learns = TypeVar("Learns", bound=LearnsByRun)
Options = TypeVar("Options", bound=RunConfig)


class RewardRun(Generic[Learns, Options]):
    """One run: learner, buffer, and where they stand."""

    def __init__(
        self,
        plan: TrainingPlan,
        config: Options,
        folder: RunFolder,
        learner: Learns,
        lanes: int = 1,
    ) -> None:
        """``lanes`` environments fill the buffer in turn. Raises UserError if the buffer will not
        fit, and for a device that is not there."""
        self.plan = plan
        self.config = config
        self.folder = folder
        self.learner = learner
        self.numbers = config.numbers_of(plan.spec.task)
        if config.exploration_steps >= config.steps:
            raise UserError(
                f"expected more steps than the {config.exploration_steps} of exploration, found "
                f"{config.steps}: nothing would be learned; say fewer exploration-steps"
            )
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
        self.step = 0
        self.updates = 0
        self.drawn = 0
        """Updates of an autoencoder, in a recipe that has one."""
        self.episodes = 0
        self.evaluate_at = 0
        self.evaluated_step = -1
        self.seconds = 0.0
        self.losses: dict[str, float] = {}
        self.between_episodes = True
        self.episode_seeds: list[int] = []
        self._busy = 0.0
        self._saved_step = 0
        self._start_clock()

    # --- Going on, and ending -------------------------------------------------------------------

    def resume(self, repeat: Callable[[list[int], Array], None]) -> None:
        """Continues from the folder's last state, if it has one. In mid-episode, ``repeat`` puts
        the environments where the actions (age, L, A) lead from their seeds."""
        state = self.folder.load_state()
        if state:
            self.learner.load_state_dict(state["learner"])
            self.buffer.restore(self.folder.resume / "buffer", state["buffer"])
            restore_generator(self.rng, state["rng"])
            for key in _COUNTS:
                setattr(self, key, state.get(key, getattr(self, key)))
            if not self.between_episodes:
                repeat(self.episode_seeds, self.buffer.actions())
        # The rows that were reported after that state will be reported again, its evaluation too.
        reported = self.evaluated_step == self.step
        self.folder.truncate_curve("step", self.step - (not reported) if state else -1)
        self._start_clock()

    def train(
        self,
        policy: Callable[[], TorchPolicy],
        play: Play,
        record: Callable[[], TrainingRecord],
        advance: Callable[[], None],
    ) -> None:
        """Trains to the end or a Ctrl-C, which saves after the decision (or evaluation episode) at
        hand.

        ``advance`` makes decisions and the updates that are due, ``policy`` is evaluated by
        ``play``, and ``record`` says how it came about.
        """
        with interruptible(self.folder) as stop:
            while True:
                if self.evaluation_due():
                    self.evaluate(policy(), play, stop.is_set)
                if self.save_due(stop.is_set()):
                    self.save(record())
                if self.finished or stop.is_set():
                    break
                with self.busy():
                    advance()
            # Not where somebody stopped it: the last evaluation may still be due.
            if self.finished and not stop.is_set():
                self.folder.finish()

    def save_due(self, stopping: bool) -> bool:
        """At the end, where somebody is ``stopping`` it, and every ``save_every`` decisions."""
        self.seconds = time.monotonic() - self._began
        regular = self.step - self._saved_step >= self.config.save_every
        return self.finished or stopping or regular

    def save(self, record: TrainingRecord) -> None:
        """Resume state, then the policy in its shipped form."""
        state = {
            "learner": self.learner.state_dict(),
            "buffer": self.buffer.save(self.folder.resume / "buffer"),
            "rng": generator_state(self.rng),
            **{key: getattr(self, key) for key in _COUNTS},
        }
        self.folder.save_state(state)
        # The newest state is in its place: what only older ones needed goes.
        self.buffer.remove_other_parts(self.folder.resume / "buffer")
        self.plan.save(self.folder, self.acting_agent(), record)
        self._saved_step = self.step

    def record(self, how: str) -> TrainingRecord:
        """How the policy came about, as far as all recipes say it alike."""
        on_cuda = self.config.torch_device() == "cuda"
        return TrainingRecord(
            how=how,
            command=self.plan.command,
            steps=self.step,
            environment_steps=self.env_steps,
            episodes=self.episodes,
            updates=self.updates,
            batch_size=self.config.batch_size,
            alpha=self.plan.method.alpha_of(self.config.alpha),
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
        """True once all decisions are taken."""
        return self.step >= self.config.steps

    def acting_agent(self) -> Agent:
        """The agent where policies compute and are saved, which is the CPU."""
        agent = self.learner.agent
        on_cpu = agent.log_temperature.device.type == "cpu"
        return agent if on_cpu else copy.deepcopy(agent).cpu()

    # --- Evaluating and reporting ---------------------------------------------------------------

    def evaluation_due(self) -> bool:
        """At the start, at the first episode's end past every ``eval_every``, and at the end."""
        regular = self.between_episodes and self.env_steps >= self.evaluate_at
        return regular or (self.finished and self.evaluated_step != self.step)

    def evaluate(self, policy: TorchPolicy, play: Play, stop: Stop) -> None:
        """Success and return on all streams and on each alone, where ``policy`` supports it: a row
        of the curve, and the picture of all rows. Where ``stop`` says so it is left, and is due
        again when the run goes on.

        The environments are between two episodes; the next ones begin with a reset anyway.
        """
        streams = self.plan.spec.streams
        count = self.config.eval_episodes
        subsets = dict.fromkeys(("all", *single_streams(streams)))
        masks = {subset: mask_of(subset, streams) for subset in subsets}
        asked = [subset for subset in masks if count and policy.supports(masks[subset])]
        seeds = range(FIRST_SELECTION, FIRST_SELECTION + count)
        try:
            results = iter(play(policy, [(masks[s], seed) for s in asked for seed in seeds], stop))
        except Stopped:
            return
        row: dict[str, float] = {}
        for subset in asked:
            episodes = [next(results) for _ in seeds]
            row[f"success_{subset}"] = round(float(np.mean([e.success for e in episodes])), 4)
            row[f"return_{subset}"] = round(float(np.mean([e.total_reward for e in episodes])), 3)
        self.evaluated_step = self.step
        every = self.numbers.eval_every
        self.evaluate_at = (self.env_steps // every + 1) * every
        self._add_to_curve(row)
        self._measure_speed_anew()

    def _add_to_curve(self, row: dict[str, float]) -> None:
        counts = {"step": self.step, "env_steps": self.env_steps, "updates": self.updates}
        nan = float("nan")
        losses = {name: round(self.losses.get(name, nan), 5) for name in self.learner.loss_names}
        left = self._seconds_left() if self.step else ""
        clock = {"seconds": round(self.seconds, 1), "seconds_left": left, **self._speed()}
        episodes = {"episodes": self.config.eval_episodes}
        self.folder.report("curve", **counts, **clock, **episodes, **row, **losses)
        draw_curve(self.folder.path, self.plan.spec.name, self.config.steps)

    @contextmanager
    def busy(self) -> Iterator[None]:
        """Around decisions and updates, which the speed is that of; then says how far the run is,
        now and then."""
        before = time.monotonic()
        yield
        now = time.monotonic()
        self._busy += now - before
        if now - self._reported > PROGRESS_SECONDS:
            self._report()
            self._reported = now

    def _report(self) -> None:
        self.folder.report(
            "progress",
            step=self.step,
            steps=self.config.steps,
            episodes=self.episodes,
            updates=self.updates,
            seconds_left=self._seconds_left(),
            **self._speed(),
            **{name: round(value, 4) for name, value in self.losses.items()},
        )

    def _start_clock(self) -> None:
        self._reported = time.monotonic()
        self._began = self._reported - self.seconds
        self._saved_step = self.step
        self._measure_speed_anew()

    def _measure_speed_anew(self) -> None:
        self._before = (self.env_steps, self.updates, self._busy)

    def _speed(self) -> dict[str, float]:
        """Simulator steps and updates per second since the last evaluation; evaluating and saving
        are left out."""
        env_steps, updates, busy = self._before
        seconds = max(self._busy - busy, 1e-9)
        return {
            "env_steps_per_s": round((self.env_steps - env_steps) / seconds, 2),
            "updates_per_s": round((self.updates - updates) / seconds, 3),
        }

    def _seconds_left(self) -> int:
        """At the rate of all that was done so far, evaluations included."""
        return round(self.seconds / max(self.step, 1) * max(self.config.steps - self.step, 0))

    # --- Deciding -------------------------------------------------------------------------------

    @property
    def exploring(self) -> bool:
        """Whether decisions are drawn uniformly still."""
        return self.step < self.config.exploration_steps

    def draw_seeds(self, lanes: int) -> list[int]:
        """Seeds of the next training episodes: new scenes at every reset."""
        return self.rng.integers(FIRST_LEARNING, 2**31, lanes).tolist()

    def discount_of(self, last: bool) -> float:
        """The discount stored with a decision; ``last`` of its episode."""
        return 0.0 if last and not self.numbers.bootstraps else self.numbers.discount

    def explore(self, *lanes: int) -> Array:
        """(*lanes, A) uniform actions."""
        size = (*lanes, self.plan.env.action_dim)
        return self.rng.uniform(-1, 1, size).astype(np.float32)


_COUNTS = (
    "step",
    "updates",
    "drawn",
    "episodes",
    "evaluate_at",
    "evaluated_step",
    "seconds",
    "losses",
    "between_episodes",
    "episode_seeds",
)
