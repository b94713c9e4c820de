"""Sizes of the networks, apart from them: whoever reads a config needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

FEATURE_MAP = (64, 7, 7)
FEATURE_SIZE = 64 * 7 * 7
"""Z: the 3136 numbers a stream is encoded to."""


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

    @property
    def state_inputs(self) -> int:
        """How many state numbers the heads read."""
        return len(self.state_columns) or self.state_dim

    def read_state(self, state: Tensor) -> Tensor:
        """(..., S) -> (..., state_inputs)."""
        return state[..., list(self.state_columns)] if self.state_columns else state
