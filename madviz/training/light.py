"""The light recipe: MAD's weighting on an imitation loss; minutes on two cores. Not RL from
scratch.

The problem: the paper's schedule takes hours on a GPU. The idea: Meta-World ships scripted
experts, so actions can be learned by imitation, and what MAD is about (one head that reads the
merged feature and every singular one) stays exactly as it is:

    L = alpha |pi(M) - a*|^2 + (1 - alpha) mean_i |pi(V_i) - a*|^2

A run is a sequence of rounds. While round k's updates run on one core, a worker process records
the episodes of round k+1 on the other, driven by the student as it was when the round began; so
data and weights of every round are a function of the configuration alone, and a resumed run
repeats them. At 8 episodes and 300 updates a round, 12 rounds see 9,800 labelled states.

The other methods learn from the same episodes and labels, each with its own rows (``methods.py``).
Naive Both is MAD with alpha = 1 / (1 + V) here: the expert is every row's only teacher, so nothing
but the weights tells the two apart.
VIB adds its bottleneck's cost to the loss; its Gaussians have 64 numbers, and beta is 0.01, because
errors of actions are about a thousandth of the squared errors of Q that the paper's 10 stands
beside. MVD's contrastive losses have an Adam of their own, as in the paper's code.

Shipped are an exponential average of the weights and a critic fitted at the end to the recorded
rewards (``madviz.training.light_critic``), so that Q can be shown; the critic never shapes the
features.
"""

from __future__ import annotations

import copy
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from madviz.agent.agent import Agent, TorchPolicy, autocast
from madviz.agent.augment import random_shift
from madviz.policies.config import TrainingRecord
from madviz.subsets import mask_of
from madviz.system.numbers import (
    Count,
    CountOrNone,
    PixelsOrNone,
    Rate,
    Share,
    Threads,
    Weight,
    Width,
)
from madviz.training.demonstrations import Dataset, Driver, Episode, Recorder
from madviz.training.light_critic import REWARD_SCALE, fit_critic
from madviz.training.plan import TrainingPlan
from madviz.training.run_folder import RunFolder, interruptible
from madviz.types import Array


@dataclass(frozen=True)
class LightConfig:
    """The options of the light recipe; defaults were chosen by measurement on hammer."""

    rounds: Count = 12
    """Rounds of recording and updates after the first demonstrations."""
    demonstrations: Count = 10
    """Episodes driven by the (perturbed) expert before the first update."""
    episodes_per_round: Count = 8
    """Episodes recorded in a round, each driven by the student on one of its trained subsets."""
    updates_per_round: Count = 300
    """Gradient steps in a round."""
    batch_size: Width = 64
    """Labelled states in a gradient step; each is encoded once per stream."""
    learning_rate: Rate = 1e-3
    """Adam's at the start; falls linearly to 0 over the run."""
    alpha: Share = 0.5
    """Weight of the merged feature; 1 - alpha is shared by the singular subsets."""
    hidden_dim: Width = 512
    """Width of the heads' hidden layers."""
    shift: PixelsOrNone = 4
    """Pixels of random shift."""
    average: Share = 0.998
    """Decay of the exponential average of the weights that acts and is shipped."""
    expert_share: Share = 0.5
    """Probability that the expert drives a step in the first round; decays by ``share_decay``."""
    share_decay: Share = 0.8
    """Factor on ``expert_share`` from round to round."""
    noise_share: Share = 0.2
    """Probability that an action is replaced by a random one while recording."""
    noise_decay: Share = 1.0
    """Factor on ``noise_share`` from round to round. Below 1 the last rounds show where the student
    goes by itself, which is what a task needs whose end few episodes reach under noise."""
    critic_updates: CountOrNone = 1500
    """Gradient steps of the critic at the end."""
    workers: Threads = 1
    """Recording processes."""
    bottleneck_dim: Width = 64
    """VIB alone: numbers in the Gaussian of a third-person view (the paper has 3136)."""
    kl_weight: Weight = 0.01
    """VIB alone: weight of the bottleneck's cost, a mean over its numbers."""


def imitation_loss(
    agent: Agent, views: Tensor, state: Tensor, label: Tensor, masks: Tensor, weights: Tensor
) -> Tensor:
    """Weighted squared error of every row's deterministic action to the expert's, for merges
    without noise.

    views (B, V, C, H, W), state (B, S), label (B, A), masks (N, V), weights (N,) -> scalar.
    """
    return (
        row_errors(agent, agent.encode_and_merge(views, masks)[1], state, label) * weights
    ).sum()


def row_errors(agent: Agent, merged: Tensor, state: Tensor, label: Tensor) -> Tensor:
    """(N,) mean squared errors of the actions on ``merged`` (N, B, ...)."""
    rows, batch = merged.shape[:2]
    mean, _ = agent.actor(merged.flatten(0, 1), state.repeat(rows, 1))
    error = (torch.tanh(mean).unflatten(0, (rows, batch)) - label).square()
    return error.mean((1, 2))


class LightRun:
    """The state of a run and one method per thing that happens to it."""

    def __init__(self, plan: TrainingPlan, config: LightConfig, folder: Path) -> None:
        """Episodes are saved in ``folder``, for a run that is resumed."""
        self.plan, self.config, self.agent = plan, config, plan.new_agent()
        agent, streams = self.agent, plan.spec.streams
        self.masks = torch.from_numpy(plan.method.masks(streams))
        self.driven = [mask_of(name, streams) for name in plan.spec.trained_subsets]
        self.weights = torch.from_numpy(plan.method.row_weights(streams, config.alpha))
        self.average = copy.deepcopy(agent).eval().requires_grad_(False)
        learned = [*agent.encoder.parameters(), *agent.actor.parameters()]
        self.optimisers = {
            "optimiser": torch.optim.Adam(learned, lr=config.learning_rate, fused=True)
        }
        if agent.merge.own_optimiser:
            encoder = agent.encoder.parameters()
            self.optimisers[agent.merge.own_optimiser] = torch.optim.Adam(
                encoder, lr=config.learning_rate, fused=True
            )
        total = config.demonstrations + config.rounds * config.episodes_per_round
        self.data = Dataset(streams, total, plan.env.horizon)
        self.rng = np.random.default_rng(plan.seed)
        self.round = self.updates = 0
        self.seconds = 0.0
        self._episodes = folder / "episodes"
        self._episodes.mkdir(exist_ok=True)

    def drivers(self, round_index: int) -> list[tuple[Driver, int]]:
        """Who drives which seed in a round: the trained subsets in turn, round 0 the expert.

        A function of the configuration, the round, and the average at the time of the call.
        """
        config = self.config
        if round_index == 0:
            demonstration = Driver(1.0, config.noise_share)
            return [(demonstration, self._train_seed(i)) for i in range(config.demonstrations)]
        share = config.expert_share * config.share_decay ** (round_index - 1)
        noise = config.noise_share * config.noise_decay ** (round_index - 1)
        student = TorchPolicy(self.plan.spec, copy.deepcopy(self.average))
        first = config.demonstrations + (round_index - 1) * config.episodes_per_round
        planned = []
        for number in range(first, first + config.episodes_per_round):
            mask = self.driven[number % len(self.driven)]
            driver = Driver(share, noise, student, mask)
            planned.append((driver, self._train_seed(number)))
        return planned

    def add(self, episodes: list[Episode], round_index: int) -> None:
        """Adds a round's episodes to the data and to the run folder."""
        for number, episode in enumerate(episodes):
            episode.save(self._episodes / f"{round_index:03d}-{number:02d}.npz")
            self.data.add(episode)

    def learn(self) -> float:
        """One round of updates; the mean loss."""
        total = 0.0
        for _ in range(self.config.updates_per_round):
            total += self.update()
        self.round += 1
        return total / self.config.updates_per_round

    def update(self) -> float:
        """One gradient step; the imitation loss."""
        config = self.config
        index = self.rng.integers(0, len(self.data), config.batch_size)
        # Of this update alone, so that a resumed run draws the same.
        generator = torch.Generator().manual_seed(self.plan.seed * 1_000_003 + self.updates)
        noise = self.agent.noise(config.batch_size, generator)
        views = random_shift(self.data.views(index), self.rng, pad=config.shift)
        state, label = self.data.column("states", index), self.data.column("labels", index)
        with autocast():
            features, merged = self.agent.encode_and_merge(views, self.masks, noise)
            loss = (row_errors(self.agent, merged, state, label) * self.weights).sum()
        penalty = self.agent.merge.penalty(self.agent.encoder, features)
        self._step("optimiser", loss if penalty is None else loss + config.kl_weight * penalty)
        if self.agent.merge.own_optimiser:
            self._own_step(index, generator)
        decay = min(config.average, (1 + self.updates) / (10 + self.updates))
        with torch.no_grad():
            pairs = zip(self.average.parameters(), self.agent.parameters(), strict=True)
            for slow, fast in pairs:
                slow.lerp_(fast, 1 - decay)
        self.updates += 1
        return loss.item()

    def _own_step(self, index: Array, generator: torch.Generator) -> None:
        """The merge's own loss, on freshly shifted pictures; the last decision of an episode has
        no next one and is its own."""
        horizon, shift = self.data.horizon, self.config.shift
        following = np.minimum(index + 1, index - index % horizon + horizon - 1)
        now, then = (
            random_shift(self.data.views(i), self.rng, pad=shift) for i in (index, following)
        )
        positive = int(torch.randint(now.shape[1], (), generator=generator))
        merge = self.agent.merge
        loss = merge.own_loss(self.agent.encoder, now, then, positive, autocast)
        self._step(merge.own_optimiser, loss)

    def _step(self, name: str, loss: Tensor) -> None:
        config, optimiser = self.config, self.optimisers[name]
        progress = self.updates / (config.rounds * config.updates_per_round)
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * (1 - progress)
        for every in self.optimisers.values():
            every.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()

    def _train_seed(self, number: int) -> int:
        # Training seeds stay below 1000; a run with more episodes meets scenes again.
        return (self.plan.seed * 137 + number) % 1000

    def state(self) -> dict[str, Any]:
        """Everything ``restore`` needs to go on exactly."""
        return {
            "agent": self.agent.state_dict(),
            "average": self.average.state_dict(),
            **{name: optimiser.state_dict() for name, optimiser in self.optimisers.items()},
            "rng": _plain(self.rng.bit_generator.state),
            "round": self.round,
            "updates": self.updates,
            "seconds": self.seconds,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from ``state``; episodes come back from the run folder."""
        self.agent.load_state_dict(state["agent"])
        self.average.load_state_dict(state["average"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state[name])
        self.rng.bit_generator.state = _unplain(state["rng"])
        self.round, self.updates, self.seconds = (state[k] for k in ("round", "updates", "seconds"))
        for file in sorted(self._episodes.glob("*.npz")):
            if int(file.name.split("-")[0]) <= self.round:
                self.data.add(Episode.load(file))


def train_light(plan: TrainingPlan, config: LightConfig, folder: RunFolder) -> None:
    """Trains by the light recipe, from the folder's last state on if it has one; Ctrl-C saves after
    the round at hand. Raises UserError if a recording process is killed."""
    run = LightRun(plan, config, folder.resume)
    state = folder.load_state()
    if state:
        run.restore(state)
        folder.truncate_curve("round", run.round)
    with closing(Recorder(plan.drawn_task, config.workers)) as recorder:
        run_rounds(run, folder, recorder)


def run_rounds(run: LightRun, folder: RunFolder, recorder: Recorder) -> None:
    """The loop: round k's updates use the episodes of rounds 0..k; meanwhile round k+1 is recorded
    by the student as it stood at the start of round k."""
    config = run.config
    began = time.monotonic() - run.seconds
    if len(run.data) == 0:
        run.add(Recorder.finish(recorder.start(run.drivers(0))), 0)
    with interruptible(folder) as stop:
        while run.round < config.rounds and not stop.is_set():
            ahead = run.round + 1
            recording = recorder.start(run.drivers(ahead)) if ahead < config.rounds else []
            loss = run.learn()
            episodes = Recorder.finish(recording)
            run.add(episodes, ahead)
            run.seconds = time.monotonic() - began
            folder.save_state(run.state())
            _report(run, folder, loss, episodes)
            if run.round < config.rounds:
                _save(run, folder, final=False)
        if run.round >= config.rounds:
            _save(run, folder, final=True)
            folder.finish()


def _save(run: LightRun, folder: RunFolder, final: bool) -> None:
    """Writes the averaged weights as a policy; the critic is fitted when nothing else changes."""
    plan, config, began = run.plan, run.config, time.monotonic()
    updates = config.critic_updates if final else 0
    if updates:
        fit_critic(run.average, run.data, plan.method, config.alpha, updates, plan.seed)
    record = TrainingRecord(
        how="imitation of a scripted expert that labels the student's own states; "
        "not reinforcement learning from scratch",
        command=plan.command,
        expert_demonstrations=config.demonstrations,
        labelled_episodes=run.data.episodes,
        environment_steps=len(run.data) * plan.env.action_repeat,
        updates=run.updates,
        critic_updates=updates,
        batch_size=config.batch_size,
        alpha=config.alpha,
        seeds=f"network and data {plan.seed}, episodes below 1000",
        wall_time_s=round(run.seconds + time.monotonic() - began),
        finished=final,
    )
    plan.save(folder, run.average, record, REWARD_SCALE)


def _report(run: LightRun, folder: RunFolder, loss: float, episodes: list[Episode]) -> None:
    done = run.round / run.config.rounds
    rate = float(np.mean([e.success for e in episodes])) if episodes else float("nan")
    folder.report(
        "curve",
        round=run.round,
        updates=run.updates,
        episodes=run.data.episodes,
        seconds=round(run.seconds, 1),
        seconds_left=round(run.seconds * (1 - done) / done, 1),
        loss=round(loss, 5),
        student_success=round(rate, 3),
    )


def _plain(state: Any) -> Any:
    """NumPy's generator state holds 128-bit integers, which only text carries safely."""
    if isinstance(state, dict):
        return {key: _plain(value) for key, value in state.items()}
    return f"int:{state}" if isinstance(state, int) else state


def _unplain(state: Any) -> Any:
    if isinstance(state, dict):
        return {key: _unplain(value) for key, value in state.items()}
    return int(state[4:]) if isinstance(state, str) and state.startswith("int:") else state
