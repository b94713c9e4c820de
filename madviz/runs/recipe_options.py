"""Options of recipes: what ``resolve`` asks of all, and what those that learn from rewards share.

A recipe's options are a frozen dataclass below ``RecipeOptions``, which overrides what differs; no
recipe is named outside its own files and its field of ``TrainConfig``.

Discount, evaluations and time limits are the paper's for the task at hand: they differ between
its two suites (``SuiteNumbers``). Where an option says otherwise, the option counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

import torch

from madviz.agent.sizes import NetworkConfig
from madviz.errors import UserError
from madviz.system.machine import cores
from madviz.system.numbers import CountOrNone, Share, Steps, Width
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
        """Sizes of an agent that reads ``state_columns`` of the state, or all of it if empty."""
        ...

    def threads(self) -> int:
        """How many the learner takes where the user does not say: one for each core."""
        return cores()


@dataclass(frozen=True)
class SuiteNumbers:
    """The paper's numbers that differ between its two suites; time limits are as in its code."""

    discount: float
    eval_every: int
    """Simulator steps."""
    bootstraps: bool
    """True where the target goes on past an episode's last step."""


METAWORLD = SuiteNumbers(0.99, 25_000, True)
MANISKILL = SuiteNumbers(0.8, 20_000, False)


@dataclass(frozen=True)
class RunConfig(RecipeOptions):
    """Options of every recipe that learns from rewards, whatever it learns."""

    steps: Steps = 500_000
    """Decisions in the whole run."""
    exploration_steps: Steps = 2_000
    """Decisions drawn uniformly before the policy acts; no update of it before that."""
    batch_size: Width = 256
    """Transitions in an update."""
    buffer_capacity: Steps = 500_000
    """Transitions that are remembered."""
    buffer_packed: bool = True
    """Pack frames in memory without loss: a quarter of the bytes; every batch is the same."""
    buffer_on_disk: bool = False
    """Keep frames, as they are, in files of the run's folder; memory need not hold them."""
    discount: Share | None = None
    """Gamma; by default 0.99, and 0.8 for ManiSkill."""
    time_limit: Literal["suite", "goes-on", "ends"] = "suite"
    """``goes-on``: the target goes on past an episode's last step, as nothing really ends there.
    ``ends``: the last reward is all. ``suite``: as in the paper's code, it goes on in Meta-World
    and ends in ManiSkill."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """The networks learn there; ``auto`` takes CUDA where there is one."""
    eval_every: Steps | None = None
    """Simulator steps between evaluations; by default 25000, and 20000 for ManiSkill."""
    eval_episodes: CountOrNone = 20
    """Deterministic episodes for each subset; 0: none, and no success in the curve."""
    save_every: Steps = 2_000
    """Decisions between checkpoints."""

    ONLY_TIME = ("buffer_packed", "buffer_on_disk", "save_every")

    def numbers_of(self, task: str) -> SuiteNumbers:
        """The paper's for ``task``, but where an option says otherwise."""
        suite = MANISKILL if task.startswith("maniskill/") else METAWORLD
        return SuiteNumbers(
            suite.discount if self.discount is None else self.discount,
            suite.eval_every if self.eval_every is None else self.eval_every,
            suite.bootstraps if self.time_limit == "suite" else self.time_limit == "goes-on",
        )

    def torch_device(self) -> str:
        """Raises UserError where CUDA is asked for and not there."""
        there = torch.cuda.is_available()
        if self.device == "cuda" and not there:
            raise UserError(
                "expected a CUDA device for the option device = cuda, found none that PyTorch can "
                "use; see `nvidia-smi`, or leave the option out"
            )
        return "cuda" if there and self.device != "cpu" else "cpu"

    def frames_device(self) -> str:
        """In whose memory the buffer's frames are."""
        return "cpu"
