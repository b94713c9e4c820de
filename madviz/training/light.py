"""The light recipe: MAD's weighting on an imitation loss; minutes on two cores. Not RL from
scratch.

The problem: the paper's schedule takes hours on a GPU. The idea: Meta-World ships scripted
experts, so actions can be learned by imitation, and what MAD is about (one head that reads the
merged feature and every singular one) stays exactly as it is:

    L = alpha |pi(M) - a*|^2 + (1 - alpha) mean_i |pi(V_i) - a*|^2      (light_losses)

A run is a sequence of rounds. While round k's updates run on one core, a worker process records
the episodes of round k+1 on the other, driven by the student as it was when the round began; so
data and weights of every round are a function of the configuration alone, and a resumed run
repeats them. At 8 episodes and 300 updates a round, 12 rounds see 9,800 labelled states.

The other methods learn from the same episodes and labels, each with its own rows (``methods.py``).
MV-MAE's autoencoder has an Adam of its own; it learns from the pictures as they were recorded, and
the actor is taught on those it reads of shifted ones.

Shipped are an exponential average of the weights and a critic fitted at the end to the recorded
rewards (``madviz.training.light_critic``), so that Q can be shown; the critic never shapes the
features.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from madviz.agent.agent import TorchPolicy, autocast
from madviz.agent.augment import random_shift
from madviz.agent.networks import read_state
from madviz.agent.update import generator_state, restore_generator
from madviz.errors import UserError
from madviz.policies.config import TrainingRecord
from madviz.policies.seeds import training_seed
from madviz.runs.demonstrations import Dataset, Driver, Episode, Recorder
from madviz.runs.run_folder import RunFolder, interruptible
from madviz.runs.training_plan import TrainingPlan
from madviz.subsets import mask_of
from madviz.training.kept_episodes import FOLDER, KeptEpisodes, episode_files
from madviz.training.light_critic import REWARD_SCALE, fit_critic
from madviz.training.light_focus import Outcomes, failures, focused, in_turn, shares
from madviz.training.light_losses import PlacesHead as PlacesHead
from madviz.training.light_losses import check_places, mean_and_std
from madviz.training.light_losses import imitation_loss as imitation_loss
from madviz.training.light_losses import row_errors as row_errors
from madviz.training.light_options import OF_DRIVERS
from madviz.training.light_options import LightConfig as LightConfig
from madviz.types import Array


class LightRun:
    """The state of a run and one method per thing that happens to it."""

    def __init__(self, plan: TrainingPlan, config: LightConfig, folder: Path) -> None:
        """Episodes are saved in ``folder``, for a run that is resumed. Raises UserError for kept
        episodes that do not fit."""
        self.plan = plan
        self.config = config
        self.agent = plan.new_agent()
        agent = self.agent
        streams = plan.spec.streams
        self.masks = torch.from_numpy(plan.method.masks(streams))
        # The drivers at alpha 0 and 1, too, where some of these subsets are not trained: runs with
        # published rates were driven so.
        subsets = plan.method.trained_subsets(streams)
        subsets = subsets if config.drivers == "turns" else ["all"]
        self.driven = [mask_of(name, streams) for name in subsets]
        self._even = plan.method.row_weights(streams, config.alpha)
        self.weights = torch.from_numpy(self._even)
        self.outcomes: Outcomes = []
        self.average = copy.deepcopy(agent).eval().requires_grad_(False)
        learned = [*agent.encoder.parameters(), *agent.actor.parameters()]
        self.optimisers = {
            "optimiser": torch.optim.Adam(learned, lr=config.learning_rate, fused=True)
        }
        if agent.encoder.own_optimiser:
            self.optimisers[agent.encoder.own_optimiser] = torch.optim.Adam(
                agent.encoder.parameters(), lr=config.learning_rate, fused=True
            )
        total = config.demonstrations + (config.rounds - 1) * config.episodes_per_round
        self.data = Dataset(streams, total, plan.env.horizon)
        self.rng = np.random.default_rng(plan.seed)
        self.places: PlacesHead | None = None
        self.round = self.updates = 0
        self.seconds = 0.0
        self._episodes = folder / FOLDER
        self._kept = KeptEpisodes(plan, config) if config.episodes else None
        if asked := config.asked(OF_DRIVERS.get(config.drivers, ())):
            raise UserError(
                f"expected light.drivers {config.drivers!r} without {', '.join(asked)}, which has "
                "no effect beside it; leave it out"
            )

    def drivers(self, round_index: int) -> list[tuple[Driver, int]]:
        """The driver of each seed in a round: the trained subsets in turn, round 0 the expert. None
        where the episodes are recorded already.

        A function of the configuration, the round, and of the average and the outcomes at the time
        of the call.
        """
        config = self.config
        if self._kept is not None:
            return []
        fade = config.noise_decay ** max(round_index - 1, 0)
        noise = config.noise_share * fade
        spread = config.noise_spread * fade
        first = config.demonstrations + (round_index - 1) * config.episodes_per_round
        if round_index == 0 or config.drivers == "expert":
            expert = Driver(1.0, noise, noise_spread=spread)
            numbers = range(first, first + config.episodes_per_round)
            numbers = numbers if round_index else range(config.demonstrations)
            return [(expert, training_seed(self.plan.seed, number)) for number in numbers]
        share = config.expert_share * config.share_decay ** (round_index - 1)
        student = TorchPolicy(self.plan.spec, copy.deepcopy(self.average))
        planned = []
        for number, chosen in enumerate(
            in_turn(self.shares(), config.episodes_per_round, first), first
        ):
            driver = Driver(share, noise, student, self.driven[chosen], spread)
            planned.append((driver, training_seed(self.plan.seed, number)))
        return planned

    def shares(self) -> Array:
        """(K,) of the subsets that drive, by where the student has failed."""
        return shares(failures(self.outcomes, len(self.driven)), self.config.focus)

    def add(
        self, episodes: list[Episode], round_index: int, planned: list[tuple[Driver, int]]
    ) -> None:
        """Adds a round's episodes, which went as ``planned``, to the data and to the run folder."""
        self._episodes.mkdir(exist_ok=True)
        if round_index == 0 and self._kept is None:  # What a run left that never began.
            for files in episode_files(self._episodes).values():
                for file in files:
                    file.unlink()
        for number, episode in enumerate(episodes):
            if self._kept is None:
                episode.save(self._episodes / f"{round_index:03d}-{number:02d}.npz")
            self.data.add(episode)
        if round_index == 0:
            self.look_at(self._demonstrations())
        elif planned and planned[0][0].student is not None:
            drove = [self._place(driver) for driver, _ in planned]
            found = [episode.success for episode in episodes]
            self.outcomes.append(list(zip(drove, found, strict=True)))

    def _place(self, driver: Driver) -> int:
        """The index of a student's mask in ``driven``."""
        assert driver.mask is not None
        return [tuple(mask) for mask in self.driven].index(tuple(driver.mask))

    def _demonstrations(self) -> Array:
        return np.arange(self.config.demonstrations * self.data.horizon)

    def look_at(self, index: Array) -> None:
        """Sets what depends on how pictures, states and places vary, from the decisions ``index``
        of the first episodes."""
        config = self.config
        for agent in (self.agent, self.average):
            if agent.encoder.draws:
                agent.encoder.set_mean(self.data.usual_views(index))
        if config.standard_state:
            read = read_state(self.plan.networks, self.data.column("states", index))
            for agent in (self.agent, self.average):
                agent.scale_state(*mean_and_std(read.numpy()))
        if config.position_weight:
            places = self.data.column("places", index).numpy()
            self.places = PlacesHead(self.agent.actor, places)
            group = {"params": list(self.places.parameters())}
            self.optimisers["optimiser"].add_param_group(group)

    def learn(self) -> float:
        """One round of updates; the mean loss."""
        if self.config.focus:
            rows = focused(self._even, self.masks.numpy(), self.driven, self.shares())
            self.weights = torch.from_numpy(rows)
        total = 0.0
        for _ in range(self.config.updates_per_round):
            total += self.update()
        self.round += 1
        return total / self.config.updates_per_round

    def update(self) -> float:
        """One gradient step; the imitation loss."""
        config = self.config
        index = self.drawn()
        # Of this update alone, so that a resumed run draws the same.
        generator = torch.Generator().manual_seed(self.plan.seed * 1_000_003 + self.updates)
        merge = self.agent.encoder
        noise = merge.noise(config.batch_size, generator)
        pixels = self.data.views(index)  # (B, V, C, H, W)
        views = random_shift(pixels, self.rng, pad=config.shift, centred=not merge.draws)
        state = self.data.column("states", index)  # (B, S)
        label = self.data.column("labels", index)  # (B, A)
        with autocast():
            features, merged = merge.encode_and_merge(views, self.masks, noise)  # ..., (N, B, Z)
            gripper = config.gripper_loss
            loss = imitation_loss(self.agent, merged, state, label, self.weights, gripper)
            total = loss
            if self.places is not None:
                places = self.data.column("places", index)
                errors = self.places.row_errors(self.agent.actor, merged, state, places)
                total = total + config.position_weight * (errors * self.weights).sum()
        penalty = merge.penalty(features)
        self._step("optimiser", total if penalty is None else total + penalty)
        if merge.own_optimiser:
            self._step(merge.own_optimiser, self._own_loss(index, generator))
        decay = min(config.average, (1 + self.updates) / (10 + self.updates))
        with torch.no_grad():
            pairs = zip(self.average.parameters(), self.agent.parameters(), strict=True)
            for slow, fast in pairs:
                slow.lerp_(fast, 1 - decay)
        self.updates += 1
        return loss.item()

    def drawn(self) -> Array:
        """(B,) decisions, late ones likelier where ``recency`` is above 0."""
        many = len(self.data)
        size = self.config.batch_size
        recency = self.config.recency
        if not recency:
            return self.rng.integers(0, many, size)
        place = self.rng.random(size) ** (1 / (1 + recency))  # Its density is as x ** recency.
        return np.minimum((place * many).astype(int), many - 1)

    def _own_loss(self, index: Array, generator: torch.Generator) -> Tensor:
        """The merge's: on pictures as they were recorded, if it draws them; else on freshly shifted
        ones, where the last decision of an episode has no next one and is its own."""
        merge = self.agent.encoder
        if merge.draws:
            index = index[: merge.reconstructed]
            views = self.data.views(index)
            reward = self.data.column("rewards", index)
            with autocast():
                return merge.reconstruction_loss(views, reward, generator)
        shift = self.config.shift
        now, then = (
            random_shift(self.data.views(i), self.rng, pad=shift)
            for i in (index, self.data.following(index))
        )
        positive = int(torch.randint(now.shape[1], (), generator=generator))
        return merge.own_loss(now, then, positive, autocast)

    def _step(self, name: str, loss: Tensor) -> None:
        config = self.config
        optimiser = self.optimisers[name]
        progress = self.updates / (config.all_rounds * config.updates_per_round)
        share = 1 - progress * (1 - config.learning_rate_floor)
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * share
        for every in self.optimisers.values():
            every.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()

    def state(self) -> dict[str, Any]:
        """Everything ``restore`` needs to go on exactly."""
        return {
            "agent": self.agent.state_dict(),
            "average": self.average.state_dict(),
            "places": self.places.state_dict() if self.places else {},
            **{name: optimiser.state_dict() for name, optimiser in self.optimisers.items()},
            "outcomes": self.outcomes,
            "rng": generator_state(self.rng),
            "round": self.round,
            "updates": self.updates,
            "seconds": self.seconds,
        }

    def saved(self, round_index: int) -> list[Episode]:
        """The episodes of a round that are in files: another run's, or this one's from before."""
        if self._kept is not None:
            return self._kept.round(round_index)
        files = episode_files(self._episodes).get(round_index, [])
        return [Episode.load(file) for file in files]

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from ``state``; episodes come back from the run folder. Raises UserError for a
        state that an older version saved."""
        for round_index in range(state["round"] + 1):
            for episode in self.saved(round_index):
                self.data.add(episode)
        self.look_at(self._demonstrations())
        self.load(state)

    def load(self, state: dict[str, Any]) -> None:
        """Takes everything but the episodes from ``state``."""
        self.round, self.updates, self.seconds = (state[k] for k in ("round", "updates", "seconds"))
        self.outcomes = state["outcomes"]
        self.agent.load_state_dict(state["agent"])
        self.average.load_state_dict(state["average"])
        if self.places is not None:
            self.places.load_state_dict(state["places"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state[name])
        restore_generator(self.rng, state["rng"])


def train_light(plan: TrainingPlan, config: LightConfig, folder: RunFolder) -> None:
    """Trains by the light recipe, from the folder's last state on if it has one; Ctrl-C saves after
    the round at hand. Raises UserError for options that do not fit, before anything is recorded,
    and if a recording process is killed."""
    # What is in ``resume`` goes when the run is over.
    run = LightRun(plan, config, folder.path if config.keep_episodes else folder.resume)
    if config.position_weight:
        with closing(plan.drawn_task.build()) as env:
            check_places(run.agent.actor, env)
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

    def finish(recording: list[Future[Episode]], round_index: int) -> list[Episode]:
        return run.saved(round_index) if config.episodes else Recorder.finish(recording)

    if len(run.data) == 0:
        planned = run.drivers(0)
        run.add(finish(recorder.start(planned), 0), 0, planned)
    with interruptible(folder) as stop:
        while run.round < config.all_rounds and not stop.is_set():
            ahead = run.round + 1
            planned = run.drivers(ahead) if ahead < config.rounds else []
            recording = recorder.start(planned)
            loss = run.learn()
            episodes = finish(recording, ahead)
            run.add(episodes, ahead, planned)
            run.seconds = time.monotonic() - began
            # In this order: a row without its state is dropped and comes again, a state without
            # its row would never have one.
            rate = float(np.mean([e.success for e in episodes])) if episodes else float("nan")
            report_round(run, folder, loss, {"student_success": round(rate, 3)})
            folder.save_state(run.state())
            if run.round < config.all_rounds:
                _save(run, folder, final=False)
        if run.round >= config.all_rounds:
            _save(run, folder, final=True)
            folder.finish()


def _save(run: LightRun, folder: RunFolder, final: bool) -> None:
    """Writes the averaged weights as a policy; the critic is fitted when nothing else changes."""
    plan = run.plan
    config = run.config
    began = time.monotonic()
    updates = config.critic_updates if final else 0
    if updates:
        fit_critic(run.average, run.data, plan.method, config.alpha, updates, plan.seed)
    record = TrainingRecord(
        how=f"{config.how}; not reinforcement learning from scratch",
        command=plan.command,
        expert_demonstrations=config.driven_by_expert(run.data.episodes),
        labelled_episodes=run.data.episodes,
        environment_steps=len(run.data) * plan.env.action_repeat,
        updates=run.updates,
        critic_updates=updates,
        batch_size=config.batch_size,
        alpha=plan.method.alpha_of(config.alpha),
        seeds=f"network and data {plan.seed}, episodes below 1000",
        wall_time_s=round(run.seconds + time.monotonic() - began),
        finished=final,
    )
    plan.save(folder, run.average, record, REWARD_SCALE)


def report_round(
    run: LightRun, folder: RunFolder, loss: float, measured: Mapping[str, float]
) -> None:
    """Adds a row to the run's curve: its progress in rounds, updates and seconds, its loss, and
    what was ``measured`` in this round."""
    done = run.round / run.config.all_rounds
    folder.report(
        "curve",
        round=run.round,
        updates=run.updates,
        episodes=run.data.episodes,
        seconds=round(run.seconds, 1),
        seconds_left=round(run.seconds * (1 - done) / done, 1),
        loss=round(loss, 5),
        **measured,
    )
