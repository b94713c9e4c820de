"""Training plans for tests: small ones on the toy task."""

from __future__ import annotations

from dataclasses import replace

from madviz.agent.merges.vib import VibOptions
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.agent.sizes import OwnOptions
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import CAMERAS, ToyReach
from madviz.runs.drawn_task import DrawnTask
from madviz.runs.training_plan import TrainingPlan
from madviz.types import PolicySpec
from madviz.world_model.sizes import AutoencoderConfig, MvMaeOptions

OWN = {
    "vib": VibOptions(bottleneck_dim=6, kl_weight=0.01),
    "mv-mae": MvMaeOptions(AutoencoderConfig(width=16, layers=1, decoder_layers=1), 2),
}
"""Small ones of the methods that have any."""
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
        NetworkConfig(6, 2, hidden_dim=hidden_dim, own=OWN.get(method, OwnOptions())),
        METHODS[method].merge,
        seed,
    )
