"""A part of the tests that runs here, in LeRobot's own environment.

    .venv/bin/python check_acts.py FOLDER CASE    a line of JSON on what came of it

An untrained ACT with statistics of its own is saved, changed as CASE says, loaded as
serve_policy.py does, and asked for 100 decisions beside LeRobot's ``select_action``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file, save_file
from serve_policy import LeRobotPolicy

from madviz.envs.registry import env_spec
from madviz.errors import UserError
from madviz.serving.episodes import BadLook, ServedEpisodes
from madviz.wire.wiring import served

CAMERAS = ("first", "third_a", "third_b")
STATE = 6
SIZE = 40
SHAPES = {"first": (48, 64), "third_a": (40, 40), "third_b": (56, 56)}


def saved(folder: Path, ensemble: bool, shapes: dict[str, tuple[int, int]]) -> None:
    """An ACT for the toy, and its processors."""
    torch.manual_seed(0)
    seen = {
        f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, *shape))
        for name, shape in shapes.items()
    }
    stats = {key: {"mean": np.full((3, 1, 1), 0.4), "std": np.full((3, 1, 1), 0.2)} for key in seen}
    seen["observation.state"] = PolicyFeature(FeatureType.STATE, (STATE,))
    stats["observation.state"] = {"mean": np.full(STATE, 0.1), "std": np.full(STATE, 0.5)}
    stats["action"] = {"mean": np.array([1.3, -0.2]), "std": np.full(2, 0.3)}
    config = ACTConfig(
        input_features=seen,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        chunk_size=10,
        n_action_steps=1 if ensemble else 5,
        temporal_ensemble_coeff=0.01 if ensemble else None,
        dim_model=32,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_heads=4,
        use_vae=False,
        pretrained_backbone_weights=None,
        device="cpu",
    )
    policy = ACTPolicy(config)
    for part in (policy, *make_pre_post_processors(config, dataset_stats=stats)):
        part.save_pretrained(folder)


def renamed(folder: Path, kind: str, old: str, new: str) -> None:
    """The statistics of a processor under other names."""
    [file] = folder.glob(f"policy_{kind}_step_*.safetensors")
    save_file({key.replace(old, new): each for key, each in load_file(file).items()}, file)


def unnormalised(folder: Path) -> None:
    """A preprocessor without its normaliser."""
    file = folder / "policy_preprocessor.json"
    document = json.loads(file.read_text())
    kept = [step for step in document["steps"] if "normalizer" not in step["registry_name"]]
    file.write_text(json.dumps({**document, "steps": kept}))


def differences(folder: Path) -> dict[str, float | int]:
    """The largest difference from the library in 100 decisions of two episodes that are played at
    the same time, and numbers outside [-1, 1]."""
    policy = LeRobotPolicy(folder, env_spec("toy/reach"))
    rng = np.random.default_rng(0)
    looks = [
        (
            {name: rng.integers(0, 256, (SIZE, SIZE, 3), np.uint8) for name in CAMERAS},
            rng.normal(size=STATE).astype(np.float32),
        )
        for _ in range(100)
    ]
    here = ServedEpisodes(policy, STATE)
    beside = ServedEpisodes(policy, STATE)
    acted = []
    for pictures, state in looks:
        acted.append(here.act(pictures, state))
        beside.act(pictures, state[::-1].copy())
    own = ACTPolicy.from_pretrained(folder).eval()
    before, after = make_pre_post_processors(own.config, pretrained_path=str(folder))
    own.reset()
    expected = []
    for pictures, state in looks:
        scaled = {
            f"observation.images.{name}": torch.from_numpy(one.transpose(2, 0, 1).copy()) / 255
            for name, one in pictures.items()
        }
        with torch.inference_mode():
            look = before({**scaled, "observation.state": torch.from_numpy(state)})
            expected.append(after(own.select_action(look))[0].numpy())
    return {
        "difference": float(np.abs(np.array(acted) - expected).max()),
        "spread": float(np.std(expected)),
        "outside": int((np.abs(acted) > 1).sum()),
        "outside there": int((np.abs(expected) > 1).sum()),
        "chunk": policy.spec.chunk,
    }


def own_shapes(folder: Path) -> dict[str, object]:
    """Prints the greeting and the answers of a policy of three picture shapes."""
    policy = LeRobotPolicy(folder, env_spec("toy/reach"), letterbox=True)
    episodes = ServedEpisodes(policy, STATE)
    pictures = {n: np.zeros((*s, 3), np.uint8) for n, s in SHAPES.items()}
    action = episodes.act(pictures, np.zeros(STATE, np.float32))
    wiring = served(policy)["wiring"]
    try:
        episodes.act({**pictures, "first": np.zeros((64, 64, 3), np.uint8)}, np.zeros(STATE))
        refused = ""
    except BadLook as error:
        refused = str(error)
    return {"action": len(action), "size": wiring["size"], "boxed": wiring["letterbox"],
            "refused": refused}  # fmt: skip


def result(folder: Path, case: str) -> dict[str, object]:
    squares = {name: (SIZE, SIZE) for name in CAMERAS}
    saved(folder, case == "ensembling", SHAPES if "shapes" in case else squares)
    if case == "no preprocessor":
        for file in folder.glob("policy_preprocessor*"):
            file.unlink()
    elif case == "renamed action":
        renamed(folder, "postprocessor", "action.", "actions.")
    elif case == "renamed state":
        renamed(folder, "preprocessor", "observation.state.", "observation.states.")
    elif case == "no normaliser":
        unnormalised(folder)
    if case == "shapes boxed":
        return own_shapes(folder)
    try:
        return {**differences(folder)}
    except UserError as error:
        return {"refused": str(error)}


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(result(Path(sys.argv[1]), sys.argv[2])))
