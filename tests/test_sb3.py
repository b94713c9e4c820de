"""Policies of Stable-Baselines3: trained on our tasks, loaded only where somebody trusts it."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from dataclasses import replace
from queue import Queue
from typing import Any

import gymnasium
import numpy as np
import pytest
import stable_baselines3 as sb3
import torch
from gymnasium.wrappers import RescaleAction
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize, VecTransposeImage

import madviz.policies.sb3
from madviz.app.forking import prepare
from madviz.app.session_maker import SessionMaker
from madviz.cli import main
from madviz.envs.gymnasium_env import MadvizEnv
from madviz.envs.registry import env_spec, make_env
from madviz.errors import UserError
from madviz.measure.evaluate import evaluate
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Ablation, Occlusion
from madviz.policies.checkpoint import load_policy
from madviz.policies.players import Reader, player_of
from madviz.policies.sb3 import VARIABLE, shown_sb3, trust
from madviz.policies.sb3_policy import Sb3Policy
from madviz.session.frame import Frame, NoFrame
from madviz.session.process import SessionProcess
from madviz.types import PolicyWithMemory
from tests.sessions import Recorder


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A few updates of PPO on the toy, colour and depth."""
    env = gymnasium.make("madviz/reach-v0", flat=True)
    options = {"features_extractor_kwargs": {"cnn_output_dim": 16}, "net_arch": [16]}
    ppo = sb3.PPO("MultiInputPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=1,
                  policy_kwargs=options, device="cpu")  # fmt: skip
    ppo.learn(32)
    file = tmp_path_factory.mktemp("sb3") / "ppo.zip"
    ppo.save(file)
    return ppo, file


@pytest.fixture(autouse=True)
def nobody_trusts(monkeypatch):
    monkeypatch.setenv(VARIABLE, "")


def test_nothing_is_loaded_that_nobody_trusts(model):
    with pytest.raises(UserError, match="runs code when it is loaded.*--trust"):
        load_policy(f"sb3:{model[1]}@toy/reach")


def test_a_name_without_zip_is_the_file_with_it(model, monkeypatch):
    trust(f"sb3:{model[1].with_suffix('')}@toy/reach", True)
    assert os.environ[VARIABLE].endswith("ppo.zip")
    names = (model[1].with_suffix(""), model[1])
    short, whole = (load_policy(f"sb3:{name}@toy/reach").spec for name in names)
    assert short == whole


def test_it_acts_here_as_it_acts_in_its_own_program(model):
    ppo, file = model
    name = f"sb3:{file}@toy/reach"
    trust(name, True)
    policy = load_policy(name)
    assert not policy.spec.can_drop
    assert set(policy.spec.streams) == {
        f"{camera}{kind}" for camera in ("first", "third_a", "third_b") for kind in ("", ".depth")
    }
    there, total, ended = MadvizEnv("toy/reach", flat=True), 0.0, False
    seen, _ = there.reset(seed=5000)
    while not ended:
        action, _ = ppo.predict(seen, deterministic=True)
        seen, reward, _, ended, _ = there.step(np.clip(action, -1, 1))
        total += float(reward)
    here = evaluate(policy, ["all"], episodes=1, seed=5000)
    assert here.episodes[0].total_reward == pytest.approx(total, abs=1e-6)


def test_it_is_watched_and_measured_as_any_other(model, capsys):
    name = f"sb3:{model[1]}@toy/reach"
    words = ["eval", "--policy", name, "--subsets", "all", "--episodes", "1", "--workers", "0"]
    assert main(words) == 2 and "--trust" in capsys.readouterr().err
    assert main([*words, "--trust", "--occlude", "first=black"]) == 0
    session = Recorder(load_policy(name))
    session.at(0.0)
    assert not session.steps(3).pace.error
    with pytest.raises(UserError, match="cannot act on 'first'"):
        evaluate(load_policy(name), ["first"], episodes=1)
    black = evaluate(
        load_policy(name), ["all"], episodes=1, occlusions={"first": Occlusion("black")}
    )
    assert black.rows["all"]["n"] == 1


def test_every_command_that_loads_it_takes_the_users_word(model, tmp_path, monkeypatch, capsys):
    name, file = f"sb3:{model[1]}@toy/reach", tmp_path / "saved.madviz.json"
    trust(name, True)
    session = Recorder(load_policy(name), seed=7)
    session.at(0.0)
    session.steps(2)
    session.save().write(file)
    alone = ["--conditions", "all", "first=black", "--episodes", "1", "--workers", "0"]
    for words, code, said in (
        (["compare", name, *alone], 0, ""),
        (["replay", str(file), "--policy", name], 0, ""),
        (["serve", "--policy", name, "--check", "nowhere"], 2, "recordings for --check"),
    ):
        monkeypatch.setenv(VARIABLE, "")
        assert main(words) == 2 and f"--trust, or set {VARIABLE}" in capsys.readouterr().err
        assert main([*words, "--trust"]) == code
        printed = capsys.readouterr().err
        assert said in printed and "--trust" not in printed


@pytest.mark.parametrize("trusted", [True, False])
def test_a_visitors_simulation_knows_whether_it_is_trusted(model, trusted):
    """The process that it is forked from was there before anybody said so."""
    prepare()
    name, news = f"sb3:{model[1]}@toy/reach", Queue()
    made = SessionMaker(name, typed=name, trusted=trusted)
    session = SessionProcess(made)
    session.subscribe(news.put)
    session.start()
    try:
        found = news.get(timeout=60)
    finally:
        session.close()
    if trusted:
        assert isinstance(found, Frame)
    else:
        assert isinstance(found, NoFrame) and "add --trust" in found.error


def test_a_folder_may_have_an_at_in_its_name(model, tmp_path):
    file = tmp_path / "a@b" / "model.zip"
    file.parent.mkdir()
    shutil.copy(model[1], file)
    name = f"sb3:{file}@toy/reach"
    with pytest.raises(UserError, match=r"a@b/model\.zip: a file of Stable-Baselines3 runs code"):
        load_policy(name)
    trust(name, True)
    assert load_policy(name).spec.task == "toy/reach"


def test_what_is_no_such_policy_is_said(model, tmp_path):
    wrong = tmp_path / "wrong.zip"
    wrong.write_bytes(b"PK nothing")
    for name, said in (
        (f"sb3:{wrong}@toy/reach", "expected a policy of Stable-Baselines3"),
        (f"sb3:{model[1]}", "found no task"),
        (f"sb3:{model[1]}@toy/run", "unknown task"),
        (f"sb3:{model[1]}@metaworld/hammer", "expected 4 action numbers"),
    ):
        trust(name, True)
        with pytest.raises(UserError, match=said):
            load_policy(name)


SMALL = {"flat": True, "depth": False, "size": 48}
NETWORK = {"features_extractor_kwargs": {"cnn_output_dim": 8}, "net_arch": [8]}


def small_env(**options):
    chosen = {"task": "toy/reach", **SMALL, **options}
    return make_vec_env(MadvizEnv, n_envs=1, seed=0, env_kwargs=chosen)


def saved(envs, file, policy_kwargs=NETWORK, steps=0, **options):
    """An almost untrained PPO of ``envs``, and the file it was saved to."""
    ppo = sb3.PPO("MultiInputPolicy", envs, n_steps=8, batch_size=8, n_epochs=1, seed=0,
                  policy_kwargs=policy_kwargs, device="cpu", **options)  # fmt: skip
    if steps:
        ppo.learn(steps)
    ppo.save(file)
    return ppo, file


def loaded(file, statistics=None, task="toy/reach"):
    name = f"sb3:{file}{f'+{statistics}' if statistics else ''}@{task}"
    trust(name, True)
    return load_policy(name)


def acts_as_trained(policy, ppo, envs, decisions=12):
    """Plays one episode in ``envs`` and the same here; compares every action. The first number of
    an episode is a seed."""
    envs.seed(5000)
    seen = envs.reset()
    env = make_env("toy/reach", cameras=policy.spec.cameras)
    stack = stack_of(policy.spec, env.spec)
    now = env.reset(5000)
    player = player_of(policy, 5000)
    assert isinstance(player, Reader)
    everything = np.ones(len(policy.spec.streams), bool)
    for step in range(decisions):
        there, _ = ppo.predict(seen, deterministic=True)
        views = {camera.name: env.view(camera.name) for camera in env.spec.cameras}
        stack.push(views, Ablation(), 5000, step)
        here = player.act(policy.encode(stack.views, now.state), everything)
        np.testing.assert_allclose(here, np.clip(there[0], -1, 1), atol=1e-6)
        # Both move in large steps of its own sign, so that the frames differ.
        action = np.sign(here).astype(np.float32)
        seen, *_ = envs.step(action[None])
        now = env.step(action)
    return player


def test_depth_is_the_depth_of_training(tmp_path):
    envs = small_env(depth=True)
    ppo, file = saved(envs, tmp_path / "depth.zip")
    acts_as_trained(loaded(file), ppo, envs)
    policy = loaded(file)
    seen, _ = MadvizEnv("toy/reach", **{**SMALL, "depth": True}).reset(seed=5000)
    env = make_env("toy/reach", cameras=policy.spec.cameras)
    stack = stack_of(policy.spec, env.spec)
    now = env.reset(5000)
    stack.push({c.name: env.view(c.name) for c in env.spec.cameras}, Ablation(), 5000, 0)
    given = policy.encode(stack.views, now.state).private
    for key, part in seen.items():
        np.testing.assert_array_equal(np.reshape(given[key], part.shape), part, err_msg=key)


def test_depth_of_another_range_is_refused(tmp_path):
    class Raw(gymnasium.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            spaces: Any = dict(env.observation_space)  # type: ignore[call-overload]
            spaces["first_depth"] = gymnasium.spaces.Box(0, 1e6, (48, 48, 1), np.float32)
            self.observation_space = gymnasium.spaces.Dict(spaces)

        def observation(self, observation):
            return observation

    options = {**SMALL, "depth": True}
    envs = make_vec_env(lambda: Raw(gymnasium.make("madviz/reach-v0", **options)), n_envs=1)
    _, file = saved(envs, tmp_path / "raw.zip")
    with pytest.raises(UserError, match="first.depth from 0 to 2 m, found 0 to 1e.06; train it"):
        loaded(file)


@pytest.mark.parametrize("squash", [False, True])
def test_state_dependent_exploration_loads_and_acts(squash, tmp_path):
    envs = small_env()
    options = {**NETWORK, "squash_output": squash}
    ppo, file = saved(envs, tmp_path / "sde.zip", options, use_sde=True)
    acts_as_trained(loaded(file), ppo, envs)


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("depth", [False, True])
def test_frames_are_stacked_as_in_training(first, depth, tmp_path):
    envs = small_env(depth=depth)
    cameras = ("first", "third_a", "third_b")
    if first:
        order = {camera: "first" for camera in cameras} | {"agent_pos": "last"}
        order |= {f"{camera}_depth": "last" for camera in cameras if depth}
        envs = VecFrameStack(VecTransposeImage(envs), 3, order)
    else:
        envs = VecFrameStack(envs, 3)
    ppo, file = saved(envs, tmp_path / "stack.zip")
    policy = loaded(file)
    assert isinstance(policy, PolicyWithMemory)
    acts_as_trained(policy, ppo, ppo.get_env())


@pytest.mark.parametrize("keys", [["agent_pos"], None])
@pytest.mark.parametrize("stack", ["", "inside", "outside"])
def test_statistics_of_training_are_used_or_asked_for(keys, stack, tmp_path):
    envs = small_env()
    if stack == "inside":
        envs = VecFrameStack(envs, 2)
    normalised = VecNormalize(envs, norm_obs_keys=keys)
    envs = VecFrameStack(normalised, 2) if stack == "outside" else normalised
    ppo, file = saved(envs, tmp_path / "norm.zip", steps=32)
    with pytest.raises(UserError, match="VecNormalize.*STATISTICS.pkl@TASK"):
        loaded(file)
    normalised.save(tmp_path / "norm.pkl")
    normalised.training = False
    policy = loaded(file, tmp_path / "norm.pkl")
    assert shown_sb3(f"sb3:{file}+{tmp_path / 'norm.pkl'}@toy/reach") == (
        "sb3:norm.zip+norm.pkl@toy/reach"
    )
    acts_as_trained(policy, ppo, ppo.get_env())


@pytest.mark.parametrize("kind", [sb3.SAC, sb3.TD3])
@pytest.mark.parametrize("options", [{"norm_obs_keys": ["agent_pos"]}, {"norm_obs": False}, None])
def test_an_off_policy_model_of_a_normalised_state_needs_its_statistics(kind, options, tmp_path):
    envs = VecTransposeImage(small_env())
    if options is not None:
        envs = VecNormalize(envs, **options)
    model = kind("MultiInputPolicy", envs, buffer_size=50, learning_starts=4, batch_size=4, seed=0,
                 policy_kwargs=dict(NETWORK), device="cpu")  # fmt: skip
    model.learn(8)
    file = tmp_path / "off.zip"
    model.save(file)
    if not (options and "norm_obs_keys" in options):
        assert loaded(file).spec.method.endswith("Policy")
        return
    with pytest.raises(UserError, match="VecNormalize.*STATISTICS.pkl@TASK"):
        loaded(file)
    assert isinstance(envs, VecNormalize)
    envs.save(tmp_path / "norm.pkl")
    envs.training = False
    acts_as_trained(loaded(file, tmp_path / "norm.pkl"), model, model.get_env(), decisions=5)


def test_statistics_are_code_too_and_nobody_trusted_them(tmp_path):
    envs = VecNormalize(small_env(), norm_obs_keys=["agent_pos"])
    _, file = saved(envs, tmp_path / "norm.zip")
    envs.save(tmp_path / "norm.pkl")
    trust(f"sb3:{file}@toy/reach", True)
    with pytest.raises(UserError, match="norm.pkl: a file of Stable-Baselines3 runs code"):
        load_policy(f"sb3:{file}+{tmp_path / 'norm.pkl'}@toy/reach")


def test_statistics_of_another_policy_are_refused(tmp_path):
    _, file = saved(small_env(), tmp_path / "plain.zip")
    stacked = VecNormalize(VecFrameStack(small_env(), 2), norm_obs_keys=["agent_pos"])
    stacked.save(tmp_path / "other.pkl")
    with pytest.raises(UserError, match=r"statistics of agent_pos with the shape \(6,\)"):
        loaded(file, tmp_path / "other.pkl")
    (tmp_path / "wrong.pkl").write_bytes(b"nothing")
    with pytest.raises(UserError, match="expected statistics of VecNormalize, found"):
        loaded(file, tmp_path / "wrong.pkl")


OWN = """
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor


class Extractor(BaseFeaturesExtractor):
    def __init__(self, space):
        super().__init__(space, 8)
        self.net = torch.nn.Linear(space["agent_pos"].shape[0], 8)

    def forward(self, seen):
        return self.net(seen["agent_pos"])
"""


def test_a_class_of_the_users_own_is_found_or_named(tmp_path, monkeypatch):
    (tmp_path / "own_extractor.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("own_extractor")
    envs = small_env()
    options = {"features_extractor_class": module.Extractor, "net_arch": [8]}
    ppo, file = saved(envs, tmp_path / "own.zip", options)
    acts_as_trained(loaded(file), ppo, envs)
    monkeypatch.delattr(module, "Extractor")
    with pytest.raises(UserError, match="policy_kwargs cannot be read.*Extractor"):
        loaded(file)
    monkeypatch.setitem(sys.modules, "own_extractor", None)
    with pytest.raises(UserError, match="needs the Python module own_extractor.*PYTHONPATH"):
        loaded(file)


def test_weights_that_do_not_fit_are_one_whole_line(model, tmp_path):
    data, parameters, variables = load_from_zip_file(str(model[1]), device="cpu")
    assert data is not None
    data["policy_kwargs"]["net_arch"] = [17]
    save_to_zip_file(tmp_path / "odd.zip", data, parameters, variables)
    with pytest.raises(
        UserError, match="found: Error.* loading state_dict for [^:]*: ."
    ) as refusal:
        loaded(tmp_path / "odd.zip")
    assert "\n" not in str(refusal.value)


def test_actions_of_another_range_are_refused(tmp_path):
    def wide():
        least, largest = np.full(2, -2, np.float32), np.full(2, 2, np.float32)
        return RescaleAction(gymnasium.make("madviz/reach-v0", **SMALL), least, largest)

    _, file = saved(make_vec_env(wide, n_envs=1), tmp_path / "wide.zip")
    with pytest.raises(UserError, match="expected actions from -1 to 1, found -2 to 2; .*wrapper"):
        loaded(file)


def test_a_policy_of_another_task_with_as_many_actions_is_refused(tmp_path, monkeypatch):
    _, file = saved(small_env(), tmp_path / "reach.zip")
    other = replace(env_spec("toy/reach"), task="toy/other", state_dim=9)
    monkeypatch.setattr(madviz.policies.sb3, "env_spec", lambda task: other)
    with pytest.raises(UserError, match="agent_pos of 9 numbers .* of toy/other, found .6,.; name"):
        loaded(file, task="toy/other")


def test_numbers_outside_the_range_are_counted_before_they_are_clipped(tmp_path):
    envs = small_env()
    ppo, _ = saved(envs, tmp_path / "far.zip")
    with torch.no_grad():
        parameters = dict(ppo.policy.named_parameters())
        parameters["action_net.bias"].copy_(torch.tensor([3.0, 0.0]))
    ppo.save(tmp_path / "far.zip")
    policy = loaded(tmp_path / "far.zip")
    assert isinstance(policy, Sb3Policy)
    acts_as_trained(policy, ppo, envs, decisions=2)
    assert acts_as_trained(policy, ppo, envs, decisions=5).outside == 5
    assert policy.outside == 7
