"""Policy folders without weights, with any rates one likes: what reports and comparisons read."""

from __future__ import annotations

import random
from dataclasses import asdict
from pathlib import Path
from typing import Any

from madviz.envs.registry import SETTINGS
from madviz.measure.statistics import wilson
from madviz.system.files import write_json
from madviz.types import CameraSpec

NETWORKS = {"state_dim": 6, "action_dim": 2, "frame_stack": 3, "hidden_dim": 8}


def write_policy(
    root: Path,
    rates: dict[str, float],
    *,
    task: str = "metaworld/hammer",
    method: str = "mad",
    setting: str = "three",
    recipe: str = "light",
    merge: str = "sum",
    alpha: float | None = 0.5,
    updates: int = 6000,
    steps: int | None = None,
    seed: int = 1,
    episodes: int = 100,
    first_seed: int = 5000,
    streams: tuple[str, ...] | None = None,
    camera: str = "",
    folder: str | None = None,
) -> Path:
    """A folder whose subsets succeed at exactly ``rates``, on seeds drawn by chance."""
    name = "-".join([task.replace("/", "-"), method, recipe])
    names = streams or SETTINGS[setting].streams
    cameras = dict.fromkeys(stream.split(".")[0] for stream in names)
    path = root / (folder or name)
    path.mkdir(parents=True)
    config: dict[str, Any] = {
        "format": 1,
        "name": name,
        "task": task,
        "method": method,
        "setting": setting,
        "recipe": recipe,
        "definition": "at the last step: it is done",
        "render_profile": "fast",
        "streams": list(names),
        "trained_subsets": ["all"],
        "image_size": 84,
        "cameras": [asdict(CameraSpec(camera, camera, 60)) for camera in cameras],
        "horizon": 100,
        "action_repeat": 2,
        "merge": merge,
        "camera": camera,
        "reward_scale": 1.0,
        "networks": NETWORKS,
        "training": {
            "command": f"madviz train --task {task} --method {method} --seed {seed}",
            "alpha": alpha,
            "updates": updates,
            "steps": steps,
        },
    }
    write_json(path / "config.json", config)
    write_json(path / "evaluation.json", evaluation(config, rates, episodes, first_seed, seed))
    return path


def evaluation(
    config: dict[str, Any], rates: dict[str, float], episodes: int, first_seed: int, seed: int
) -> dict[str, Any]:
    """The document ``madviz eval`` would have written."""
    subsets, listed = {}, []
    for subset, rate in rates.items():
        successes = round(rate * episodes)
        outcomes = [number < successes for number in range(episodes)]
        random.Random(f"{config['name']} {subset} {seed}").shuffle(outcomes)
        subsets[subset] = {
            "success": successes / episodes,
            "success_any": 1.0,
            "n": episodes,
            "ci95": list(wilson(successes, episodes)),
            "trained": True,
        }
        listed += [
            {
                "subset": subset,
                "seed": first_seed + number,
                "success": success,
                "success_any": True,
                "return": 1.0,
            }
            for number, success in enumerate(outcomes)
        ]
    return {
        "schema": 1,
        "policy": config["name"],
        "digest": "none",
        "task": config["task"],
        "definition": config["definition"],
        "render_profile": "fast",
        "occlusions": "",
        "seed": first_seed,
        "subsets": subsets,
        "episodes": listed,
    }


def rates(whole: float, first: float, third_a: float, third_b: float) -> dict[str, float]:
    return {"all": whole, "first": first, "third_a": third_a, "third_b": third_b}
