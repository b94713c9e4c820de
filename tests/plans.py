"""Training plans for tests: small ones on the toy task."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace

import pytest

from madviz.agent.merges.vib import VibOptions
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.agent.sizes import OwnOptions
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import CAMERAS, ToyReach
from madviz.runs.demonstrations import Driver, Episode, Recorder, record_episode
from madviz.runs.drawn_task import DrawnTask
from madviz.runs.training_plan import TrainingPlan
from madviz.types import Environment, PolicySpec
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


class InlineRecorder:
    """Records at once, in this process, by default the toy task; can break off after so many
    plans."""

    def __init__(
        self,
        env: Environment | None = None,
        streams: tuple[str, ...] = THREE,
        breaks_after: int = 1000,
    ) -> None:
        self.env = env or ToyReach()
        self.streams = streams
        self.left = breaks_after

    def start(self, plan: list[tuple[Driver, int]]) -> list[Future[Episode]]:
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        futures: list[Future[Episode]] = []
        for driver, seed in plan:
            future: Future[Episode] = Future()
            future.set_result(record_episode(self.env, self.streams, driver, seed))
            futures.append(future)
        return futures

    def close(self) -> None:
        pass


def record_inline(patch: pytest.MonkeyPatch) -> None:
    """Trainings of the light recipe record in this process; no other is started."""

    def start(self: Recorder, plan: list[tuple[Driver, int]]) -> list[Future[Episode]]:
        return InlineRecorder(self._task.build(), self._task.streams).start(plan)

    patch.setattr(Recorder, "start", start)
