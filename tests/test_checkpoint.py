"""Policy folders: what is saved acts the same when loaded, and everything broken is refused."""

import copy
import json
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.networks import Encoder, NetworkConfig
from madviz.cli import main
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.policies import checkpoint
from madviz.policies import config as config_module
from madviz.policies.checkpoint import describe, find_policy, load_policy, save_policy
from madviz.policies.config import TrainingRecord
from madviz.policies.listing import list_everything
from madviz.types import PolicySpec
from tests.evidence import write_policy

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


@pytest.fixture
def folder(tmp_path):
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


def test_a_loaded_policy_acts_as_the_saved_agent_did_up_to_half_precision(folder):
    loaded = load_policy(folder)
    original = read(TorchPolicy(loaded.spec, make_agent()))
    for name in ("action", "q", "merged"):
        found, expected = getattr(read(loaded), name), getattr(original, name)
        assert np.allclose(found, expected, rtol=5e-3, atol=5e-3), name
        assert found.dtype == np.float32


def test_full_precision_is_exact(tmp_path):
    save_policy(tmp_path / "p", make_agent(), make_config(), half=False)
    loaded = load_policy(tmp_path / "p")
    assert np.array_equal(read(loaded).action, read(TorchPolicy(loaded.spec, make_agent())).action)


def test_loading_twice_gives_the_same_bits_and_leaves_the_global_generator_alone(folder):
    before = torch.random.get_rng_state()
    first, second = read(load_policy(folder)), read(load_policy(folder))
    assert np.array_equal(first.q, second.q) and np.array_equal(first.action, second.action)
    assert torch.equal(before, torch.random.get_rng_state())


def test_loading_keeps_the_fast_memory_format(folder):
    policy = load_policy(folder)
    assert isinstance(policy, TorchPolicy)
    assert isinstance(policy.agent.encoder, Encoder)
    weight = policy.agent.encoder.conv2.weight
    assert weight.is_contiguous(memory_format=torch.channels_last)


def test_only_the_acting_part_is_saved_and_small(folder):
    names = load_file(folder / "weights.safetensors")
    assert {name.split(".")[0] for name in names} == {"encoder", "actor", "critic"}
    assert {tensor.dtype for tensor in names.values()} == {torch.float16}
    assert sorted(p.name for p in folder.iterdir()) == ["config.json", "weights.safetensors"]


def test_the_papers_networks_stay_below_10_megabytes(tmp_path):
    config = make_config(networks=NetworkConfig())
    save_policy(tmp_path, Agent(NetworkConfig()), config)
    assert (tmp_path / "weights.safetensors").stat().st_size < 10e6


def test_spec_comes_from_the_config(folder):
    spec = describe(folder).spec
    assert spec == load_policy(folder).spec
    assert (spec.name, spec.task, spec.method) == ("toy-reach-mad-light", "toy/reach", "mad")
    assert spec.streams == ("first", "third_a", "third_b") and spec.frame_stack == 3
    assert len(spec.digest) == 64


def test_config_explains_itself(folder):
    config = json.loads((folder / "config.json").read_text())
    assert config["definition"].startswith("at the last step: the hand is within")
    assert [camera["name"] for camera in config["cameras"]] == ["first", "third_a", "third_b"]
    assert config["cameras"][1]["position"] == [0, 0, 2.2]
    assert config["training"]["versions"]["torch"] == torch.__version__.split("+")[0]
    assert "cores" in config["training"]["hardware"]


def test_digest_names_weights_and_config(folder):
    digests = {describe(folder).spec.digest}
    edit_config(folder, name="other")
    digests.add(describe(folder).spec.digest)
    save_policy(folder, make_agent(1), make_config("other"))
    digests.add(describe(folder).spec.digest)
    assert len(digests) == 3
    text = (folder / "config.json").read_text()
    (folder / "config.json").write_text(text + "\n\n")
    assert describe(folder).spec.digest in digests  # Layout is not content.


def test_golden_format_1(tmp_path):
    """What format 1 wrote must load for ever: names, shapes, digest and the action that follows."""
    shapes = {
        "encoder.conv1": (32, 9, 8, 8),
        "encoder.conv2": (64, 32, 4, 4),
        "encoder.conv3": (64, 64, 3, 3),
        "actor.trunk.linear": (50, 3136),
        "critic.trunk.linear": (50, 3136),
        "actor.trunk.norm": (50,),
        "critic.trunk.norm": (50,),
        "actor.mlp.0": (8, 56),
        "actor.mlp.2": (8, 8),
        "actor.mlp.4": (4, 8),
        "critic.q1.0": (8, 58),
        "critic.q2.0": (8, 58),
        "critic.q1.2": (8, 8),
        "critic.q2.2": (8, 8),
        "critic.q1.4": (1, 8),
        "critic.q2.4": (1, 8),
    }
    rng, tensors = np.random.default_rng(0), {}
    for name, shape in shapes.items():
        for part, size in (("weight", shape), ("bias", shape[:1])):
            values = rng.normal(0, 1 / np.sqrt(np.prod(size[1:]) or 1), size)
            tensors[f"{name}.{part}"] = torch.tensor(values, dtype=torch.float16)
    golden = Path(__file__).with_name("golden_format_1.json").read_text()
    (tmp_path / "config.json").write_text(golden)
    save_file(tensors, tmp_path / "weights.safetensors")
    policy = load_policy(tmp_path)
    assert policy.spec.trained_subsets == ("all", "first", "third_a", "third_b")
    expected = [[-0.5966, 0.5856], [-0.6105, 0.5997], [-0.762, 0.6805]]
    assert read(policy).action == pytest.approx(np.array(expected), abs=2e-3)


def test_old_formats_are_repaired_by_named_functions(folder, monkeypatch):
    def merge_was_implied(config):
        return {**config, "format": 1, "merge": "sum"}

    edit_config(folder, format=0, merge=None)
    with pytest.raises(UserError, match="expected format 1, found 0"):
        load_policy(folder)
    monkeypatch.setitem(config_module.REPAIRS, 0, merge_was_implied)
    assert load_policy(folder).spec.name == "toy-reach-mad-light"


# --- Finding ---


def test_names_are_found_under_the_roots(folder, monkeypatch, tmp_path):
    monkeypatch.setenv("MADVIZ_CHECKPOINTS", str(folder.parent))
    assert load_policy("toy-reach-mad-light").spec.task == "toy/reach"
    monkeypatch.delenv("MADVIZ_CHECKPOINTS")
    monkeypatch.chdir(tmp_path)
    assert load_policy("toy-reach-mad-light").spec.task == "toy/reach"


def test_an_unknown_policy_lists_the_known_ones(folder, monkeypatch):
    monkeypatch.setenv("MADVIZ_CHECKPOINTS", str(folder.parent))
    with pytest.raises(UserError, match=r"unknown policy 'nope'.*toy-reach-mad-light"):
        load_policy("nope")


def test_bring_your_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_1.py").write_text(
        "from madviz.examples.own_policy import make\n"
        "class Mine: spec = encode = read = supports = 0\n"
        "def wrong(): return 3\n"
    )
    assert load_policy("mine_1:make").spec.name == "finder"
    with pytest.raises(UserError, match="kind madviz.types.PolicySpec, found a int"):
        load_policy("mine_1:Mine")
    with pytest.raises(UserError, match="found a int without spec, encode"):
        load_policy("mine_1:wrong")
    for missing in ("mine_1:absent", "absent_module:make"):
        with pytest.raises(UserError, match="can be imported from here"):
            load_policy(missing)
    assert str(tmp_path) not in sys.path


# --- Bad input: one line, and it names what was expected ---

BROKEN_CONFIGS = {
    "not json": ("{", "expected a JSON file"),
    "nan": ('{"format": NaN}', "NaN, which is not JSON"),
    "not text": (b"\xff\xfe\x00", "expected a JSON file"),
    "a list": ("[]", "expected a policy's config"),
    "somebody else's": ('{"model_type": "llama"}', "expected a policy's config"),
    "the future": ('{"format": 2}', "expected format 1, found 2"),
    "nothing else": ('{"format": 1}', "expected 'name', found none"),
}


@pytest.mark.parametrize(("content", "message"), BROKEN_CONFIGS.values(), ids=BROKEN_CONFIGS)
def test_broken_configs(folder, content, message):
    (folder / "config.json").write_bytes(
        content if isinstance(content, bytes) else content.encode()
    )
    for use in (load_policy, describe):
        with pytest.raises(UserError, match=message) as error:
            use(folder)
        assert "\n" not in str(error.value)


WRONG_FIELDS = {
    "no streams": ({"streams": []}, "expected streams of the cameras"),
    "foreign stream": ({"streams": ["fourth"]}, "expected streams of the cameras"),
    "foreign subset": ({"trained_subsets": ["fourth"]}, "trained_subsets: unknown camera subset"),
    "wrong type": ({"horizon": "long"}, "'horizon' to be a whole number"),
    "unknown merge": ({"merge": "product"}, "unknown merge 'product'"),
    "wrong pose": (
        {"cameras": [{"name": "first", "label": "First", "fovy": 60, "position": [0, 0]}]},
        r"expected 'cameras\[0\].position' to be a list of length 3",
    ),
    "unknown network": ({"networks": {"layers": 3}}, "networks that cannot be built"),
    "negative network": ({"networks": {"hidden_dim": -1}}, "networks that cannot be built"),
    "giant network": ({"networks": {"hidden_dim": 10**7}}, "of shape"),
    "a mean without a spread": (
        {"networks": {"state_dim": 2, "state_mean": [0.5, 0.5]}},
        "expected state_spread of 2 finite numbers above 0, found none",
    ),
    "no pair": (
        {"networks": {"log_std_bounds": [1]}},
        "'networks.log_std_bounds' to be a list of length 2",
    ),
    "a camera without limit": (
        {"cameras": [{"name": "first", "label": "First", "fovy": 60, "size": 10**9}]},
        "size of camera first from 16 to 512",
    ),
    "pictures without limit": ({"image_size": 10**9}, "'image_size' to be a whole number <= 512"),
    "an episode without end": ({"horizon": 10**12}, "'horizon' to be a whole number <= 1000000"),
    "no command line": ({"training": {"command": "'"}}, "expected a command line, found No clos"),
    "other network": ({"networks": {"state_dim": 6, "action_dim": 2}}, "of shape"),
}


@pytest.mark.parametrize(("change", "message"), WRONG_FIELDS.values(), ids=WRONG_FIELDS)
def test_configs_that_do_not_fit(folder, change, message):
    edit_config(folder, **change)
    with pytest.raises(UserError, match=message) as error:
        load_policy(folder)
    assert "\n" not in str(error.value)


def test_truncated_weights(folder):
    file = folder / "weights.safetensors"
    file.write_bytes(file.read_bytes()[:-1000])
    with pytest.raises(UserError, match="truncated or something else"):
        load_policy(folder)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04" * 100, b"\x80\x05" + bytes(100)])
def test_weights_of_another_kind(folder, content):
    (folder / "weights.safetensors").write_bytes(content)
    with pytest.raises(UserError, match="expected a safetensors file"):
        load_policy(folder)


def test_no_weights(folder):
    (folder / "weights.safetensors").unlink()
    with pytest.raises(UserError, match="expected the policy's weights, found no such file"):
        load_policy(folder)


def test_foreign_safetensors(folder):
    save_file({"lm_head.weight": torch.zeros(3)}, folder / "weights.safetensors")
    with pytest.raises(UserError, match=r"missing: actor.*extra: lm_head.weight"):
        load_policy(folder)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite(folder, value):
    edit_weights(folder, lambda tensors: tensors["actor.mlp.0.bias"].fill_(value))
    with pytest.raises(UserError, match="NaN or infinity in actor.mlp.0.bias"):
        load_policy(folder)


def test_a_missing_tensor_and_a_misshapen_one(folder):
    edit_weights(folder, lambda tensors: tensors.pop("critic.q1.0.bias"))
    with pytest.raises(UserError, match=r"missing: critic.q1.0.bias; extra: none"):
        load_policy(folder)
    edit_weights(folder, lambda tensors: tensors.update({"critic.q1.0.bias": torch.zeros(9)}))
    with pytest.raises(UserError, match=r"critic.q1.0.bias of shape \(8,\), found \(9,\)"):
        load_policy(folder)


def test_diverged_weights_are_not_saved_and_the_old_ones_stay(folder):
    digest, agent = describe(folder).spec.digest, make_agent()
    weight = dict(agent.named_parameters())["actor.trunk.linear.weight"]
    weight.data[0, 0] = 1e9  # Finite, but not in half precision.
    with pytest.raises(UserError, match="training diverged"):
        save_policy(folder, agent, make_config())
    assert describe(folder).spec.digest == digest


def test_a_failing_disk_leaves_the_old_policy(folder, monkeypatch):
    digest = describe(folder).spec.digest

    def full(*_):
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="no space left"):
        save_policy(folder, make_agent(1), make_config())
    assert describe(folder).spec.digest == digest
    assert len(list(folder.iterdir())) == 2


def test_another_environment_is_refused():
    policy, env = make_config().spec(""), ToyReach().spec
    config_module.check_environment(policy, env)
    moved = replace(env.cameras[0], fovy=61)
    for other, message in (
        (replace(env, render_profile="full"), "render profile = fast"),
        (replace(env, state_dim=24), "state numbers = 6, this environment has 24"),
        (replace(env, cameras=(moved, *env.cameras[1:])), "camera first"),
        (replace(env, cameras=env.cameras[1:]), "unknown camera 'first'"),
    ):
        with pytest.raises(UserError, match=message):
            config_module.check_environment(policy, other)
    relabelled = replace(env.cameras[0], label="Hand camera")
    config_module.check_environment(policy, replace(env, cameras=(relabelled, *env.cameras[1:])))


# --- Listing ---


def test_list_shows_success_of_these_weights_only_and_what_is_broken(folder, monkeypatch):
    monkeypatch.setattr(checkpoint, "policy_roots", lambda: [folder.parent])
    row = {"success": 0.9, "success_any": 1.0, "n": 10, "ci95": [0.5, 1.0], "trained": True}
    measure(folder, {"all": row})
    (folder.parent / "broken").mkdir()
    (folder.parent / "broken" / "config.json").write_text("{")
    listed = list_everything()
    assert (
        listed["schema"] == 1 and "toy/reach" in listed["tasks"] and "three" in listed["settings"]
    )
    assert listed["methods"]["mad"]["recipes"] and "needs" in listed["methods"]["mad"]
    (policy,) = listed["policies"]
    assert policy["name"] == "toy-reach-mad-light" and policy["path"] == str(folder)
    assert policy["success"] == {"all": {"success": 0.9, "n": 10, "ci95": [0.5, 1.0]}}
    assert [b["name"] for b in listed["broken"]] == ["broken"]
    json.dumps(listed)
    save_policy(folder, make_agent(1), make_config())
    assert list_everything()["policies"][0]["success"] == {}


def test_list_says_which_rows_have_no_weights(folder, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("MADVIZ_CHECKPOINTS", str(folder.parent))
    bare = write_policy(tmp_path / "results" / "tables", {"all": 0.9}, folder="bare", episodes=10)
    listed = list_everything()
    assert {row["name"]: row["weights"] for row in listed["policies"]}[folder.name] is True
    (row,) = [row for row in listed["without_weights"] if row["path"] == str(bare)]
    assert row["weights"] is False and row["success"]["all"]["n"] == 10
    assert set(row) == set(listed["policies"][0])
    assert main(["list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert lines["bare"].endswith("all 0.90 (n=10)   no weights")
    assert "no weights" not in lines[folder.name]
    assert find_policy("bare") == bare, "what is listed can be compared"
    with pytest.raises(UserError, match="expected the policy's weights, found no such file"):
        load_policy("bare")


def test_listing_needs_no_torch(folder):
    code = (
        "import sys, madviz.policies.listing as l; l.list_everything();"
        "assert 'torch' not in sys.modules"
    )
    env = {**os.environ, "MADVIZ_CHECKPOINTS": str(folder.parent)}
    subprocess.run([sys.executable, "-c", code], check=True, env=env, timeout=60)
