"""The recipe ``mv-mwm``: a world model on a masked autoencoder over views, an actor-critic in its
imagination (Seo et al., 2023); the last of the MAD paper's baselines.

    explore, in L environments      meanwhile the autoencoder learns to draw all views from some,
                                    and then the world model what actions lead to
    act, in L environments          meanwhile, ``update_ratio`` times a decision, one update each of
                                    autoencoder, world model, actor and critic

The MAD paper ran it without demonstrations. With ``--mv-mwm.demonstrations`` episodes of the
scripted expert are there from the start: a quarter of every batch of the world model is theirs, and
the actor is taught the expert's actions in them besides. The autoencoder does not see them.

With the defaults 20,000 decisions are 800 + 4,000 updates: each sees 16 stretches of 4 decisions
and, after the first 800, imagines 64 x 15 more. ``unlike`` says what differs from the authors'
code; it stands on every card.

On a CUDA device (``--mv-mwm.device``) it learns there. No such device was at hand when this was
written: THAT NEVER RAN.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import fields

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from madviz.agent.agent import TorchPolicy
from madviz.errors import UserError
from madviz.policies.config import TrainingRecord
from madviz.policies.seeds import FIRST_SELECTION, training_seed
from madviz.runs.buffer import Stretch
from madviz.runs.demonstrations import Dataset, Driver, record_episode
from madviz.runs.lanes_run import lanes_of, train_in_lanes
from madviz.runs.reward_run import RewardRun
from madviz.runs.run_folder import RunFolder
from madviz.runs.training_plan import TrainingPlan
from madviz.types import Array
from madviz.world_model.learner import WorldLearner
from madviz.world_model.mv_mwm_options import SIZES, MvMwmConfig

SCHEDULE = "in the imagination of a world model"
FIRST_PICTURES = 256
"""Decisions that the mean picture of a camera is taken over."""
DEMONSTRATED = 4
"""One of so many stretches of a batch is an expert's, where there are demonstrations."""
_SMOOTHING = 0.02
"""Share of the newest losses in those that are reported."""


def unlike(config: MvMwmConfig) -> str:
    """The differences from the authors' code, for the card."""
    weights = SIZES[config.size].own.autoencoder.moving_weight > 0
    return (
        "beliefs are rebuilt from nothing over a frame stack, without the actions in between, so "
        "that a policy keeps no memory; the world model is trained on short stretches, too, and "
        "predicts them also without their pictures; "
        "the state is given to actor and critic, and predicted in imagination; "
        "views are dropped uniformly, also where the world model reads them; "
        "the autoencoder sees single frames of 84 pixels in patches of 14, keeps up to whole views"
        f"{' and weights what moves' if weights else ''}; learned questions read its tokens; "
        "batches, rates and schedule are those of the command"
    )


class MvMwmRun(RewardRun[WorldLearner, MvMwmConfig]):
    """A run of the recipe; see the module."""

    demonstrations: Dataset | None = None

    def __init__(self, plan: TrainingPlan, config: MvMwmConfig, folder: RunFolder) -> None:
        agent = plan.new_agent().to(config.torch_device())
        gamma = config.numbers_of(plan.spec.task).discount
        learner = WorldLearner(agent, config, gamma, plan.seed)
        super().__init__(plan, config, folder, learner, config.environments)

    def learn(self) -> None:
        """The updates that are due: those of a pretraining while exploring, and of all four
        networks from then on."""
        config = self.config
        lanes = config.environments
        needed = config.ahead * lanes  # Before that no lane has a stretch to draw.
        if self.step < max(needed, min(self.plan.env.horizon * lanes, config.exploration_steps)):
            return
        if not self.drawn:
            self.learner.net.set_mean(self._first_pictures())
        self.learner.set_learning_rates(self.step / config.steps)
        explored = min(1.0, self.step / config.exploration_steps)
        while self.drawn < int(config.pretraining * explored):
            self._learn_pictures()
        before = int(config.world_pretraining * max(0.0, 2 * explored - 1))
        while self.updates < before:
            self._learn_world(imagines=False)
        since = max(0, self.step - config.exploration_steps)
        while self.updates < before + int(since * config.update_ratio):
            self._learn_pictures()
            self._learn_world(imagines=True)

    def _learn_pictures(self) -> None:
        index = self.buffer.draw(self.config.pictures, self.rng)
        seen = self.buffer.stretch(index, 1)
        views = seen.frames[-2]  # Before the decision whose reward it is.
        self._note(self.learner.learn_pictures(views, seen.reward[0]))
        self.drawn += 1

    def _learn_world(self, imagines: bool) -> None:
        config = self.config
        labels = None
        expert = max(1, config.batch_size // DEMONSTRATED) if self.demonstrations else 0
        index = self.buffer.draw(config.batch_size - expert, self.rng, config.ahead)
        stretch = self.buffer.stretch(index, config.ahead)
        if self.demonstrations:
            theirs, labels = demonstrated(self.demonstrations, expert, config.ahead, self.rng)
            stretch = beside(stretch, theirs)
        self._note(self.learner.update(stretch, labels, imagines))
        self.updates += 1

    def _first_pictures(self) -> Tensor:
        """(B, V, 3, H, W) of some decisions so far."""
        index = self.buffer.draw(FIRST_PICTURES, self.rng)
        return self.buffer.stretch(index, 1).frames[-1]

    def _note(self, losses: dict[str, float]) -> None:
        """Takes new losses into the running means that are reported."""
        for name, loss in losses.items():
            before = self.losses.get(name, loss)
            self.losses[name] = before + _SMOOTHING * (loss - before)

    def act(self) -> Array:
        """(L, A): what the policy draws in every lane."""
        return self.learner.act_all(*self.buffer.newest())

    def policy(self) -> TorchPolicy:
        """The policy that is evaluated."""
        return TorchPolicy(self.plan.spec, self.acting_agent())

    def described(self) -> TrainingRecord:
        """How the policy came about."""
        count = self.config.demonstrations
        facts = self.plan.env
        differs = f"{SCHEDULE}. Unlike the authors' code: {unlike(self.config)}"
        if not count:
            return self.record(f"reinforcement learning from scratch, {differs}")
        how = f"reinforcement learning and imitation of {count} episodes of a scripted expert"
        record = self.record(f"{how}, {differs}")
        return msgspec.structs.replace(
            record,
            expert_demonstrations=count,
            environment_steps=self.env_steps + count * facts.horizon * facts.action_repeat,
            seeds=f"{record.seeds}, demonstrations below {FIRST_SELECTION}",
        )


def recorded(plan: TrainingPlan, count: int) -> Dataset:
    """The demonstrations that are asked for, the same at every call."""
    streams = plan.spec.streams
    data = Dataset(streams, count, plan.env.horizon)
    with closing(plan.drawn_task.build()) as env:
        for number in range(count):
            seed = training_seed(plan.seed, number)
            data.add(record_episode(env, streams, Driver(noise_share=0.0), seed))
    return data


def demonstrated(
    data: Dataset, size: int, ahead: int, rng: np.random.Generator
) -> tuple[Stretch, Float[Tensor, "L+1 B A"]]:
    """``size`` stretches of ``ahead`` decisions from an expert's episodes, and what it would do at
    each of their L + 1 last time steps."""
    places = data.horizon - ahead
    index = rng.integers(0, data.episodes * places, size)
    index = index // places * data.horizon + index % places
    seen = torch.cat([data.views(index), data.views(index + ahead, ahead)], 2)  # (B, V, 3 T, H, W)
    known = index + np.arange(ahead + 1)[:, None]  # (L + 1, B)
    done = known[:-1]
    reward = data.column("rewards", done)
    stretch = Stretch(
        frames=seen.unflatten(2, (-1, 3)).permute(2, 0, 1, 3, 4, 5),  # (T, B, V, 3, H, W)
        state=data.column("states", known),
        action=data.column("actions", done),
        reward=reward,
        follows=torch.ones_like(reward),
    )
    return stretch, data.column("labels", known)


def beside(one: Stretch, other: Stretch) -> Stretch:
    """The samples of both."""
    names = [field.name for field in fields(Stretch)]
    return Stretch(*(torch.cat([getattr(one, name), getattr(other, name)], 1) for name in names))


def train_mv_mwm(plan: TrainingPlan, config: MvMwmConfig, folder: RunFolder) -> None:
    """Trains from the folder's last state on, if it has one; Ctrl-C saves after the decision at
    hand. Raises UserError for what the machine cannot do, for a batch too small for
    demonstrations, and for stretches that no episode has or the buffer does not hold."""
    facts = plan.env
    lanes = config.environments
    if config.demonstrations and config.batch_size < 2:
        raise UserError(
            "expected an --mv-mwm.batch-size of 2 or more, for a demonstration and what was "
            f"explored, found {config.batch_size}; raise it, or leave --mv-mwm.demonstrations out"
        )
    if config.ahead >= facts.horizon:
        raise UserError(
            f"expected an --mv-mwm.ahead below the {facts.horizon} decisions of an episode, found "
            f"{config.ahead}"
        )
    # Of each lane, the stretch that is drawn, a stack before it, and an episode that just began.
    least = lanes * (2 * config.ahead + plan.networks.frame_stack)
    if config.buffer_capacity < least:
        raise UserError(
            f"expected an --mv-mwm.buffer-capacity of {least} or more, so that {lanes} "
            f"environments have {config.ahead} decisions in a row there, found "
            f"{config.buffer_capacity}"
        )
    with lanes_of(plan, config) as envs:
        run = MvMwmRun(plan, config, folder)
        if config.demonstrations:
            run.demonstrations = recorded(plan, config.demonstrations)
        train_in_lanes(run, envs, run.act, run.learn, run.policy, run.described)
