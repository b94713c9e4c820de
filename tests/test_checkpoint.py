"""Policy folders: what is saved acts the same when loaded, is found, and is listed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.networks import Encoder, NetworkConfig
from madviz.cli import main
from madviz.errors import UserError
from madviz.policies import checkpoint
from madviz.policies import config as config_module
from madviz.policies.checkpoint import describe, find_policy, load_policy, save_policy
from madviz.policies.listing import ListConfig, run_list
from tests.checkpoints import edit_config, make_agent, make_config, measure, read, saved
from tests.evidence import write_policy


@pytest.fixture
def folder(tmp_path):
    return saved(tmp_path)


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


# --- Listing ---


def test_list_shows_success_of_these_weights_only_and_what_is_broken(folder, monkeypatch):
    monkeypatch.setattr(checkpoint, "policy_roots", lambda: [folder.parent])
    row = {"success": 0.9, "success_any": 1.0, "n": 10, "ci95": [0.5, 1.0], "trained": True}
    measure(folder, {"all": row})
    (folder.parent / "broken").mkdir()
    (folder.parent / "broken" / "config.json").write_text("{")
    listed = run_list(ListConfig())
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
    assert run_list(ListConfig())["policies"][0]["success"] == {}


def test_list_says_which_rows_have_no_weights(folder, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("MADVIZ_CHECKPOINTS", str(folder.parent))
    bare = write_policy(tmp_path / "results" / "tables", {"all": 0.9}, folder="bare", episodes=10)
    listed = run_list(ListConfig())
    assert {row["name"]: row["weights"] for row in listed["policies"]}[folder.name] is True
    (row,) = [row for row in listed["without_weights"] if row["path"] == str(bare)]
    assert row["weights"] is False and row["success"]["all"]["n"] == 10
    assert set(row) == set(listed["policies"][0])
    assert main(["list", "--all"]) == 0
    can_act, rates_only = capsys.readouterr().out.split("without weights, success rates only:")
    assert f"  {folder.name} " in can_act and f"  {folder.name} " not in rates_only
    assert "  bare " in rates_only and "  bare " not in can_act
    assert find_policy("bare") == bare, "what is listed can be compared"
    with pytest.raises(UserError, match="expected the policy's weights, found no such file"):
        load_policy("bare")


def test_listing_needs_no_torch(folder):
    code = (
        "import sys, madviz.policies.listing as l; l.run_list(l.ListConfig());"
        "assert 'torch' not in sys.modules"
    )
    env = {**os.environ, "MADVIZ_CHECKPOINTS": str(folder.parent)}
    subprocess.run([sys.executable, "-c", code], check=True, env=env, timeout=60)
