"""Training plans for tests: small ones on the toy task."""

from __future__ import annotations

from dataclasses import replace

from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import CAMERAS, ToyReach
from madviz.training.drawn_task import DrawnTask
from madviz.training.plan import TrainingPlan
from madviz.types import PolicySpec

THREE = SETTINGS["three"].streams


def toy_plan(
    method: str = "mad",
    recipe: str = "light",
    streams: tuple[str, ...] = THREE,
    horizon: int = 25,
    hidden_dim: int = 16,
    seed: int = 0,
) -> TrainingPlan:
    """What ``resolve`` would make, with episodes as long as the test wants them."""
    trained = METHODS[method].trained_subsets(streams)
    return TrainingPlan(
        PolicySpec("p", "toy/reach", method, "three", recipe, streams, trained),
        DrawnTask("toy/reach", "fast", CAMERAS, streams),
        replace(ToyReach().spec, horizon=horizon),
        NetworkConfig(6, 2, hidden_dim=hidden_dim, bottleneck_dim=6),
        METHODS[method].merge,
        seed,
    )
