"""Policy folders that are broken: each is refused in one line that names what was expected."""

import os
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file

from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.policies import config as config_module
from madviz.policies.checkpoint import describe, load_policy, save_policy
from tests.checkpoints import edit_config, edit_weights, make_agent, make_config, saved

BROKEN_CONFIGS = {
    "not json": ("{", "expected a JSON file"),
    "nan": ('{"format": NaN}', "NaN, which is not JSON"),
    "not text": (b"\xff\xfe\x00", "expected a JSON file"),
    "a list": ("[]", "expected a policy's config"),
    "somebody else's": ('{"model_type": "llama"}', "expected a policy's config"),
    "the future": ('{"format": 2}', "expected format 1, found 2"),
    "nothing else": ('{"format": 1}', "expected 'name', found none"),
}


@pytest.fixture
def folder(tmp_path):
    return saved(tmp_path)


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
