"""What ``train`` and ``resolve`` ask of the options of any recipe.

A recipe's options are a frozen dataclass below this class. Whoever adds a recipe overrides what
differs; no recipe is named outside its own files and the table ``config.RECIPES``.
"""

from __future__ import annotations

import os
from typing import ClassVar, Protocol

from madviz.agent.sizes import NetworkConfig
from madviz.types import EnvSpec


class RecipeOptions(Protocol):
    """The options of one recipe."""

    ONLY_TIME: ClassVar[tuple[str, ...]] = ()
    """Options that change how long a run takes, or how much room, and nothing else. ``--resume``
    may change them."""

    @property
    def alpha(self) -> float:
        """Weight of the merged feature in the losses."""
        ...

    def networks(self, env: EnvSpec, state_columns: tuple[int, ...]) -> NetworkConfig:
        """Of an agent that reads ``state_columns`` of the state, or all of it if empty."""
        ...

    def threads(self) -> int:
        """Of the learner, where the user does not say how many: one for each core."""
        return os.cpu_count() or 1
