"""The options of the light recipe, each with what it changes.

No included policy has the defaults alone: most had more rounds and another alpha, and some the
options below, which are off. What else was tried is in ``results/archive/tried.json``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from madviz.agent.sizes import NetworkConfig
from madviz.runs.recipe_options import RecipeOptions
from madviz.system.numbers import (
    Count,
    CountOrNone,
    Rate,
    Share,
    Shift,
    Threads,
    Weight,
    Width,
)
from madviz.types import EnvSpec

RECORDING = (
    "expert_share",
    "share_decay",
    "noise_share",
    "noise_spread",
    "noise_decay",
    "focus",
    "drivers",
    "keep_episodes",
)
"""Options that have no effect where episodes are recorded already."""
OF_DRIVERS = {"all": ("focus",), "expert": ("focus", "expert_share", "share_decay")}
"""By ``drivers``, the options that have no effect beside it."""


@dataclass(frozen=True)
class LightConfig(RecipeOptions):
    """The options of the light recipe; defaults were chosen by measurement on hammer."""

    rounds: Count = 12
    """Rounds of updates; while one goes on, the next one's episodes are recorded, so the first one
    has the demonstrations alone."""
    demonstrations: Count = 10
    """Episodes driven by the (perturbed) expert before the first update."""
    episodes_per_round: Count = 8
    """Episodes recorded in a round, each driven by the student on one of its trained subsets."""
    updates_per_round: Count = 300
    """Gradient steps in a round."""
    final_rounds: CountOrNone = 0
    """Rounds of updates alone after those, when all episodes are there."""
    batch_size: Width = 64
    """Labelled states in a gradient step; each is encoded once per stream."""
    recency: Weight = 0.0
    """How much likelier late states are drawn: the chance of the state at x, from 0 for the first
    recorded to 1 for the last, grows with x ** recency."""
    learning_rate: Rate = 1e-3
    """Adam's at the start; falls linearly over the run, to ``learning_rate_floor`` of it."""
    learning_rate_floor: Share = 0.0
    """Share of the learning rate that is left at the end, when the best episodes are there."""
    alpha: Share = 0.5
    """Weight of the merged feature; 1 - alpha is shared by the singular subsets."""
    hidden_dim: Width = 512
    """Width of the heads' hidden layers."""
    feature_dim: Width = 50
    """Numbers that a head's trunk makes of a feature."""
    standard_state: bool = False
    """The heads read speeds where the state has none, and every number less its mean in units of
    its spread in the demonstrations."""
    position_weight: Weight = 0.0
    """Weight of the squared errors of one more head, in training alone, that tells from what the
    actor reads where objects and goal are, in spreads of each coordinate."""
    gripper_loss: Literal["square", "cross-entropy"] = "square"
    """Loss of the last action number: how far it is off, or how unlikely it makes the expert's
    choice between open and closed."""
    shift: Shift = 4
    """Pixels of random shift."""
    average: Share = 0.998
    """Decay of the exponential average of the weights that acts and is shipped."""
    expert_share: Share = 0.5
    """Probability that the expert drives a step in the first round; decays by ``share_decay``."""
    share_decay: Share = 0.8
    """Factor on ``expert_share`` from round to round."""
    noise_share: Share = 0.2
    """Probability that an action is replaced by a random one while recording."""
    noise_spread: Share = 0.0
    """Spread of a noise that is added to every action while recording and changes slowly."""
    noise_decay: Share = 1.0
    """Factor on both noises from round to round. Below 1 the last rounds show where the student
    goes by itself, which is what a task needs whose end few episodes reach under noise."""
    focus: Share = 0.0
    """How far drivers and the weights of single streams follow where the student fails: 0 not at
    all, 1 in proportion to the failures of the last rounds."""
    critic_updates: CountOrNone = 1500
    """Gradient steps of the critic at the end."""
    drivers: Literal["turns", "all", "expert"] = "turns"
    """The driver after the demonstrations: the student on its trained subsets in turn, the student
    on all cameras, or the expert alone."""
    keep_episodes: bool = False
    """Keep the recorded episodes in the run's folder; 1 GB for 20 rounds of hammer."""
    episodes: str = ""
    """The folder of a run with kept episodes, to learn from those; nothing is recorded then."""
    workers: Threads = 1
    """Recording processes."""

    ONLY_TIME = ("workers",)

    def asked(self, names: Sequence[str]) -> list[str]:
        """Those of the options ``names`` that are not at their default."""
        standard = LightConfig()
        return [name for name in names if getattr(self, name) != getattr(standard, name)]

    @property
    def all_rounds(self) -> int:
        """Rounds of updates."""
        return self.rounds + self.final_rounds

    @property
    def how(self) -> str:
        """The way of learning, in words."""
        if self.episodes:
            return "imitation of a scripted expert that labels the states of another run's episodes"
        if self.drivers == "expert":
            return "imitation of a scripted expert, which drove all episodes"
        return "imitation of a scripted expert that labels the student's own states"

    def driven_by_expert(self, episodes: int) -> int:
        """How many of ``episodes`` the expert drove."""
        alone = self.drivers == "expert" and not self.episodes
        return episodes if alone else self.demonstrations

    def threads(self) -> int:
        """One: the recorder has the other core."""
        return 1

    def networks(self, env: EnvSpec, state_columns: tuple[int, ...]) -> NetworkConfig:
        changes = env.state_numbers.changes
        return NetworkConfig(
            env.state_dim,
            env.action_dim,
            feature_dim=self.feature_dim,
            hidden_dim=self.hidden_dim,
            state_columns=state_columns,
            state_changes=changes if self.standard_state and not state_columns else (),
        )
