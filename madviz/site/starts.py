"""How the episodes of seeds begin: shipped, so that no browser has to draw NumPy's random numbers.

A Meta-World reset draws twice, moves bodies *in the model*, and simulates 250 steps until the hand
is in its place. What that leads to is 60 numbers; hammer's 50 seeds are 20 kB. The browser sets
them and goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from madviz.envs.metaworld.environment import MetaWorld
from madviz.types import Array

_DATA = ("qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat")
_MOVED = ("body_pos", "site_pos")
"""The fields of a model that Meta-World's resets change."""


def start_states(env: MetaWorld, seeds: Sequence[int]) -> dict[str, Array]:
    """By name, one row for every seed: simulator, model, state numbers and the goal.

    ``state`` (K, 24) is what a policy gets; ``target`` (K, 3) metres is where the object has to go;
    ``lifted`` (K,) metres is the height that it begins at. Raises RuntimeError where a reset
    changes something that is not shipped.
    """
    rows: dict[str, list[Array]] = {name: [] for name in (*_DATA, *_MOVED, *_OWN)}
    fixed = None
    for seed in seeds:
        moment = env.reset(seed)
        model = env.simulation.model
        data = env.simulation.data
        others = _model_arrays(model)
        if fixed is not None:
            _check_same(fixed, others, seed)
        fixed = others
        for name in _DATA:
            rows[name].append(np.array(getattr(data, name)))
        for name in _MOVED:
            rows[name].append(np.array(getattr(model, name)))
        rows["state"].append(moment.state)
        rows["success"].append(np.array(moment.success, np.uint8))
        rows["target"].append(np.array(env.simulation._target_pos, float))
        rows["lifted"].append(np.array(_lifted(env.simulation), float))
    stacked = {name: np.stack(values) for name, values in rows.items()}
    return {"seeds": np.array(seeds, np.int32), **stacked}


_OWN = ("state", "success", "target", "lifted")


def _lifted(simulation: Any) -> float:
    """The height from which stick-push counts its stick as lifted; 0 in other tasks."""
    place = getattr(simulation, "stick_init_pos", None)
    return 0.0 if place is None else float(place[2])


def _model_arrays(model: Any) -> dict[str, Array]:
    names = [name for name in dir(model) if not name.startswith("_") and name not in _MOVED]
    values = {name: getattr(model, name) for name in names}
    return {k: v.copy() for k, v in values.items() if isinstance(v, np.ndarray) and v.size < 1e5}


def _check_same(before: dict[str, Array], after: dict[str, Array], seed: int) -> None:
    for name, values in before.items():
        if not np.array_equal(values, after[name], equal_nan=values.dtype.kind == "f"):
            raise RuntimeError(f"the reset of seed {seed} changed {name}, which no site ships")
