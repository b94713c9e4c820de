"""Sizes of the networks, apart from them: to read a config takes no torch."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TypeVar

FEATURE_MAP = (64, 7, 7)
FEATURE_SIZE = 64 * 7 * 7
"""Z: the 3136 numbers a stream is encoded to."""
PICTURE = 84
"""Pixels of a picture's side that give this map."""
MOVING = 10 / 255
"""A pixel moves where a channel differs by more than this from its camera's mean."""
FEWEST_MOVING = 10
"""Pixels that must move in a picture for what is drawn of it to be judged."""
FURTHEST = 5.0
"""Spreads from the mean beyond which a state number is cut off: nothing like it was trained on."""


@dataclass(frozen=True)
class OwnOptions:
    """The options that one merge has and no other. This class itself stands for none given."""

    @classmethod
    def of_recipe(cls, recipe: str) -> OwnOptions:
        """The defaults, which may differ between recipes."""
        return cls()


Own = TypeVar("Own", bound=OwnOptions)


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
    state_changes: tuple[tuple[int, int], ...] = ()
    """Pairs of state numbers, now and before, whose difference the heads read as well: speeds."""
    state_mean: tuple[float, ...] = ()
    """Subtracted from each number that the heads read; nothing if empty."""
    state_spread: tuple[float, ...] = ()
    """Each is divided by one of these after that, above 0; as many as ``state_mean``."""
    own: OwnOptions = OwnOptions()
    """The merge's own."""

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
        many = len(self.state_mean)
        spreads = list(self.state_spread)
        if len(spreads) != many or not all(0 < spread < inf for spread in spreads):
            raise ValueError(
                f"expected state_spread of {many} finite numbers above 0, found {spreads or 'none'}"
            )

    def own_as(self, kind: type[Own]) -> Own:
        """The merge's own options, which are of ``kind``; its defaults where none are given."""
        return self.own if isinstance(self.own, kind) else kind()

    @property
    def state_inputs(self) -> int:
        """How many numbers the heads read of a state."""
        return (len(self.state_columns) or self.state_dim) + len(self.state_changes)
