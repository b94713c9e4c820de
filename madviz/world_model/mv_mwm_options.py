"""The options of the recipe ``mv-mwm``, and the sizes that one of them stands for.

The numbers of the losses are those of the authors' code (Seo et al., 2023): gamma 0.99, lambda
0.95, 15 imagined decisions, entropy 1e-4, the target every 100 updates. Batches, rates and sizes
are small, for two cores; ``--mv-mwm.size paper`` has the authors' networks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from madviz.agent.sizes import NetworkConfig
from madviz.runs.lanes_run import LanesConfig
from madviz.system.numbers import Count, CountOrNone, Rate, Share, Steps, Weight, Width
from madviz.types import EnvSpec
from madviz.world_model.sizes import AutoencoderConfig, MvMwmOptions, WorldModelConfig


@dataclass(frozen=True)
class Sizes:
    """Those of all networks."""

    own: MvMwmOptions
    hidden_dim: int
    """Width of the hidden layers of actor and critic."""


SIZES = {
    "tiny": Sizes(
        MvMwmOptions(
            AutoencoderConfig(width=16, layers=1, decoder_layers=1, heads=2),
            WorldModelConfig(
                memory=16, groups=4, classes=4, hidden=16, reader_width=8, head_layers=1
            ),
        ),
        16,
    ),
    "small": Sizes(MvMwmOptions(AutoencoderConfig(width=64, layers=2, decoder_layers=1)), 256),
    "paper": Sizes(
        MvMwmOptions(
            AutoencoderConfig(width=256, layers=8, decoder_layers=6, moving_weight=0.0),
            WorldModelConfig(1024, 32, 32, 1024, reader_layers=2, reader_width=128, head_layers=4),
        ),
        512,
    ),
}


@dataclass(frozen=True)
class MvMwmConfig(LanesConfig):
    """The options of the recipe mv-mwm; see the module."""

    steps: Steps = 20_000
    """Decisions in the whole run."""
    exploration_steps: Steps = 4_000
    """Decisions drawn uniformly before the policy acts; meanwhile autoencoder and world model are
    pretrained."""
    batch_size: Width = 16
    """Stretches of an episode in an update of the world model (36)."""
    update_ratio: Weight = 0.25
    """Updates per decision, of autoencoder, world model, actor and critic (1 for 16)."""
    size: Literal["tiny", "small", "paper"] = "small"
    """Sizes of all networks: ``small`` for two cores, ``paper`` as the authors have them, ``tiny``
    to see whether everything runs."""
    hidden_dim: Width | None = None
    """Width of the hidden layers of actor and critic; by default that of ``size``: 256, 512."""
    demonstrations: CountOrNone = 0
    """Episodes of the scripted expert to learn from besides: 0 as the MAD paper ran it, 10 or more
    as the authors did."""
    cloning_weight: Weight = 1.0
    """With demonstrations: of the squared error of the actor's action there."""
    pretraining: CountOrNone = 2_000
    """Updates of the autoencoder while exploring (10000). Too few, and its tokens do not tell yet
    where small things are: on toy/reach no reward could be predicted from them after 400."""
    world_pretraining: CountOrNone = 800
    """Updates of the world model in the second half of exploring (1000, with actor and critic). An
    actor that learns from rewards that are not known yet ends at an edge and stays there."""
    pictures: Width = 16
    """Time steps in an update of the autoencoder, each with all its views (32 x 32)."""
    ahead: Count = 4
    """Decisions in a stretch that the world model learns from, after the frame stack (50)."""
    imagined_starts: CountOrNone = 64
    """Beliefs that an update imagines from, of batch_size x (ahead + 1); 0: all of them."""
    horizon: Count = 15
    """Decisions that are imagined."""
    mixture: Share = 0.95
    """Lambda: the share of what was imagined further in a return, against the critic's value."""
    entropy_weight: Weight = 1e-4
    """Weight of the entropy of actions, beside the returns."""
    kl_weight: Weight = 1.0
    """Weight of the KL between posterior and prior, beside the world model's other losses."""
    target_every: Count = 100
    """Updates between copies of the critic to its target."""
    autoencoder_rate: Rate = 1e-3
    """AdamW's (3e-4)."""
    world_rate: Rate = 1e-3
    """Adam's, of the world model (3e-4)."""
    heads_rate: Rate = 1e-3
    """The two Adams of actor and critic share it (1e-4)."""
    rate_floor: Share = 0.1
    """Share of all rates that is left at the end; they fall in a line from the first decision on
    (1: they stay)."""

    @property
    def alpha(self) -> float:
        """Without effect: every row of the recipe's method weighs alike."""
        return 0.5

    def networks(self, env: EnvSpec, state_columns: tuple[int, ...]) -> NetworkConfig:
        sizes = SIZES[self.size]
        return NetworkConfig(
            env.state_dim,
            env.action_dim,
            hidden_dim=self.hidden_dim or sizes.hidden_dim,
            state_columns=state_columns,
            own=sizes.own,
        )
