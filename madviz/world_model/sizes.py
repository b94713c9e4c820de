"""Sizes and own options of MV-MAE and MV-MWM, apart from their networks: no torch here."""

from __future__ import annotations

from dataclasses import dataclass, field

from madviz.agent.sizes import PICTURE, OwnOptions
from madviz.errors import UserError
from madviz.system.numbers import Count, CountOrNone, Pixels, Weight, Width

PATCHES = tuple(side for side in range(2, PICTURE + 1, 2) if PICTURE % side == 0)
"""Pixels of a patch's side: pictures have whole ones, and these whole squares of 2 x 2."""


@dataclass(frozen=True)
class AutoencoderConfig:
    """The sizes of the masked autoencoder over views: light ones, the paper's are in brackets."""

    patch: Pixels = 14
    """Pixels of a patch's side (16 of 96)."""
    width: Width = 128
    """Numbers of a token (256)."""
    layers: Count = 4
    """Transformer layers of the encoder (8)."""
    decoder_layers: Count = 2
    """Transformer layers of the decoder (6)."""
    heads: Count = 4
    """Attention heads of both (4)."""
    moving_weight: Weight = 20.0
    """How much more a pixel that moves counts (0)."""
    view_masking: bool = True
    """Whether views are hidden as a whole in training; if not, patches alone are, of all views."""

    def __post_init__(self) -> None:
        """Raises UserError for sizes that do not go together."""
        if self.patch not in PATCHES:
            raise UserError(
                f"expected patches of {', '.join(map(str, PATCHES))} pixels, which a picture of "
                f"{PICTURE} has, found {self.patch}"
            )
        if self.width % 4 or self.width % self.heads:
            raise UserError(
                f"expected a width of the autoencoder's tokens that 4 and its {self.heads} heads "
                f"divide, found {self.width}"
            )


@dataclass(frozen=True)
class WorldModelConfig:
    """The sizes of MV-MWM's world model: light ones, the paper's are in brackets."""

    memory: Width = 256
    """Numbers of the recurrent, deterministic part of a belief (1024)."""
    groups: Count = 16
    """Choices that the random part of a belief consists of (32)."""
    classes: Count = 16
    """Values of each choice (32)."""
    hidden: Width = 256
    """Width of hidden layers (1024)."""
    reader_layers: CountOrNone = 0
    """Transformer layers between the autoencoder's tokens and the questions to them (2)."""
    reader_width: Width = 64
    """Numbers of a token in front of the questions (128)."""
    head_layers: Count = 2
    """Hidden layers of actor and critic (4)."""

    @property
    def feature(self) -> int:
        """Z: numbers of a belief, as the heads read it."""
        return self.memory + self.groups * self.classes


@dataclass(frozen=True)
class MvMaeOptions(OwnOptions):
    """MV-MAE's own options."""

    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    reconstructed: Width = 32
    """Time steps that the autoencoder draws in a gradient step."""
    end_to_end: bool = False
    """Whether the actor's loss reaches the autoencoder, too."""


@dataclass(frozen=True)
class MvMwmOptions(OwnOptions):
    """The sizes of MV-MWM's networks besides its heads."""

    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)

    @classmethod
    def of_recipe(cls, recipe: str) -> OwnOptions:
        """None is given by itself: the recipe's option ``size`` stands for all."""
        return OwnOptions()
