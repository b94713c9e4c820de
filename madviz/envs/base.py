"""Which tasks and camera settings there are, and ``make_env``, the one way to build them.

A *setting* is what a policy is given: which cameras, in which modalities. An environment always
draws colour and depth of every camera, so a setting only picks and names streams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from madviz.types import Array, Environment, Modality, UserError, unknown

RenderProfile = Literal["fast", "full"]

METAWORLD_TASKS = (
    *("basketball", "hammer", "peg-insert-side", "soccer", "sweep-into"),
    *("assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push"),
    *("shelf-place", "disassemble", "stick-pull", "stick-push", "pick-place-wall"),
)
"""The paper's 15 tasks: five medium, five hard, five very hard."""

TASKS = (*(f"metaworld/{task}" for task in METAWORLD_TASKS), "toy/reach")


@dataclass(frozen=True)
class Setting:
    """The cameras and modalities a policy is trained with."""

    cameras: tuple[str, ...]
    modalities: tuple[Modality, ...] = ("rgb",)

    @property
    def streams(self) -> tuple[str, ...]:
        """Stream names in the order of axis V; plain camera names where RGB is all there is."""
        if self.modalities == ("rgb",):
            return self.cameras
        return tuple(f"{c}.{m}" for c in self.cameras for m in self.modalities)


THREE = ("first", "third_a", "third_b")
SETTINGS: dict[str, Setting] = {
    "three": Setting(THREE),
    "three-rgbd": Setting(THREE, ("rgb", "depth")),
}


def setting(name: str) -> Setting:
    """The setting called ``name``. Raises UserError listing the known ones."""
    if name not in SETTINGS:
        raise unknown("setting", name, list(SETTINGS))
    return SETTINGS[name]


def make_env(task: str, render_profile: str = "fast") -> Environment:
    """Builds ``suite/task``, for example ``metaworld/hammer`` or ``toy/reach``.

    ``render_profile`` is ``fast`` (no shadows, reflections or multisampling: 12 to 15 times faster
    on a CPU) or ``full`` (the simulator's stock flags). A policy must see what it was trained on.
    Raises UserError for unknown names and for a machine that cannot draw.
    """
    if render_profile not in get_args(RenderProfile):
        raise unknown("render profile", render_profile, list(get_args(RenderProfile)))
    if task not in TASKS:
        raise unknown("task", task, list(TASKS))
    suite, name = task.split("/")
    if suite == "toy":
        from madviz.envs.toy import ToyReach

        return ToyReach()
    from madviz.envs.metaworld import MetaWorld

    return MetaWorld(name, render_profile)


def check_action(action: Array, action_dim: int) -> None:
    """Raises UserError unless ``action`` is (A,) and finite; every environment calls it first."""

    found = np.asarray(action)
    if found.shape != (action_dim,) or not np.isfinite(found).all():
        raise UserError(
            f"expected a finite action of {action_dim} numbers in [-1, 1], found {found.tolist()}; "
            "the policy that produced it is broken: reset, or pick another"
        )
