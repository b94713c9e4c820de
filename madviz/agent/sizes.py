"""Sizes of the networks, apart from them: whoever reads a config needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from madviz.errors import UserError
from madviz.system.numbers import Count, CountOrNone, Pixels, Weight, Width

FEATURE_MAP = (64, 7, 7)
FEATURE_SIZE = 64 * 7 * 7
"""Z: the 3136 numbers a stream is encoded to."""
PICTURE = 84
"""Pixels of a picture's side that give this map."""
PATCHES = tuple(side for side in range(2, PICTURE + 1, 2) if PICTURE % side == 0)
"""Pixels of a patch's side: pictures have whole ones, and these whole squares of 2 x 2."""
MOVING = 10 / 255
"""A pixel moves where a channel differs by more than this from its camera's mean."""
FEWEST_MOVING = 10
"""Pixels that must move in a picture for what is drawn of it to be judged."""
FURTHEST = 5.0
"""Spreads from the mean beyond which a state number is cut off: nothing like it was trained on."""


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
class NetworkConfig:
    """Sizes of the networks; the defaults are the paper's."""

    state_dim: int = 24
    """S: proprioceptive numbers."""
    action_dim: int = 4
    """A."""
    frame_stack: int = 3
    """RGB frames stacked on the channel axis."""
    feature_dim: int = 50
    """Width of a trunk's output."""
    hidden_dim: int = 1024
    """Width of the heads' two hidden layers (the light recipe uses 512)."""
    log_std_bounds: tuple[float, float] = (-10.0, 2.0)
    """Range of the actor's log standard deviation."""
    state_columns: tuple[int, ...] = ()
    """The state numbers the heads read; all of them if empty."""
    bottleneck_dim: int = FEATURE_SIZE
    """VIB's Gaussian per third-person view (``light`` uses 64); no other method reads it."""
    state_changes: tuple[tuple[int, int], ...] = ()
    """Pairs of state numbers, now and before, whose difference the heads read as well: speeds."""
    state_mean: tuple[float, ...] = ()
    """What is subtracted from each number that the heads read; nothing if empty."""
    state_spread: tuple[float, ...] = ()
    """What each is divided by after that, above 0; as many as ``state_mean``."""
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    """MV-MAE's and MV-MWM's; no other method reads it."""
    end_to_end: bool = False
    """MV-MAE alone: whether the actor's loss reaches the autoencoder, too."""
    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)
    """MV-MWM's; no other method reads it."""

    def __post_init__(self) -> None:
        """Raises ValueError for a reading of the state that cannot be carried out."""
        read = [*self.state_columns, *(number for pair in self.state_changes for number in pair)]
        if not all(0 <= number < self.state_dim for number in read):
            raise ValueError(f"expected state numbers below {self.state_dim}, found {read}")
        if len(self.state_mean) not in (0, self.state_inputs):
            raise ValueError(
                f"expected state_mean of {self.state_inputs} numbers, found {len(self.state_mean)}"
            )
        if not all(-inf < mean < inf for mean in self.state_mean):
            raise ValueError(f"expected a finite state_mean, found {list(self.state_mean)}")
        many, spreads = len(self.state_mean), list(self.state_spread)
        if len(spreads) != many or not all(0 < spread < inf for spread in spreads):
            raise ValueError(
                f"expected state_spread of {many} finite numbers above 0, found {spreads or 'none'}"
            )

    @property
    def state_inputs(self) -> int:
        """How many numbers the heads read of a state."""
        return (len(self.state_columns) or self.state_dim) + len(self.state_changes)
