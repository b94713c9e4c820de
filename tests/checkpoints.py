"""Policy folders for tests: small ones, and ways to change what is in them."""

import copy
import json
from functools import cache

import msgspec
import numpy as np
import torch
from safetensors.torch import load_file, save_file

from madviz.agent.agent import Agent
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.policies import config as config_module
from madviz.policies.checkpoint import describe, save_policy
from madviz.policies.config import TrainingRecord
from madviz.types import PolicySpec

NETWORKS = NetworkConfig(state_dim=6, action_dim=2, hidden_dim=8)
MASKS = np.array([[1, 1, 1], [0, 1, 0], [0, 0, 0]], bool)


@cache
def trained(seed):
    torch.manual_seed(seed)
    return Agent(NETWORKS)


def make_agent(seed=0):
    """A copy: initialising takes a third of a second."""
    return copy.deepcopy(trained(seed))


def make_config(name="toy-reach-mad-light", **changes):
    spec = PolicySpec(
        name=name,
        task="toy/reach",
        method="mad",
        setting="three",
        recipe="light",
        streams=SETTINGS["three"].streams,
        trained_subsets=("all", "first", "third_a", "third_b"),
    )
    training = TrainingRecord(command="madviz train --task toy/reach", updates=3, seeds="0 to 9")
    config = config_module.policy_config(spec, ToyReach().spec, NETWORKS, training)
    return msgspec.structs.replace(config, **changes)


def saved(tmp_path):
    """The folder of a policy for the toy."""
    return save_policy(
        tmp_path / "checkpoints" / "toy-reach-mad-light", make_agent(), make_config()
    )


def measure(folder, rows, **changes):
    """Gives ``folder`` an evaluation of its weights with these rows by subset."""
    episode = {"subset": "all", "success": True, "success_any": True, "return": 1.0}
    document = {
        "schema": 1,
        "policy": folder.name,
        "digest": describe(folder).spec.digest,
        "task": "toy/reach",
        "definition": "at the last step: near",
        "render_profile": "fast",
        "occlusions": "",
        "seed": 5000,
        "subsets": rows,
        "episodes": [{**episode, "seed": seed} for seed in (5000, 5049)],
    }
    (folder / "evaluation.json").write_text(json.dumps({**document, **changes}))


def edit_config(folder, **changes):
    file = folder / "config.json"
    config = {**json.loads(file.read_text()), **changes}
    file.write_text(json.dumps({k: v for k, v in config.items() if v is not None}))


def edit_weights(folder, edit):
    tensors = load_file(folder / "weights.safetensors")
    edit(tensors)
    save_file(tensors, folder / "weights.safetensors")


def read(policy):
    views = np.random.default_rng(1).integers(0, 256, (3, 9, 84, 84), np.uint8)
    return policy.read(policy.encode(views, np.linspace(-1, 1, 6, dtype=np.float32)), MASKS)
