"""Policies of Stable-Baselines3: trained on our tasks, loaded only where somebody trusts it."""

from __future__ import annotations

import shutil
from queue import Queue

import gymnasium
import numpy as np
import pytest
import stable_baselines3 as sb3

from madviz.app.session_maker import SessionMaker
from madviz.cli import main
from madviz.envs.gymnasium_env import MadvizEnv
from madviz.errors import UserError
from madviz.measure.evaluate import evaluate
from madviz.observation.ablation import Occlusion
from madviz.policies.checkpoint import load_policy
from madviz.policies.sb3 import VARIABLE, trust
from madviz.session.frame import Frame, NoFrame
from madviz.session.process import SessionProcess, prepare
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
    seen, _ = there.reset(seed=60_000)
    while not ended:
        for key, part in seen.items():  # Depth reaches a policy here in 256 steps of its range.
            if key.endswith("_depth"):
                seen[key] = (np.round(np.clip(part / 2, 0, 1) * 255) / 255 * 2).astype(np.float32)
        action, _ = ppo.predict(seen, deterministic=True)
        seen, reward, _, ended, _ = there.step(np.clip(action, -1, 1))
        total += float(reward)
    here = evaluate(policy, ["all"], episodes=1)
    assert here.episodes[0].total_reward == pytest.approx(total, abs=1e-3)


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


@pytest.mark.parametrize("trusted", [True, False])
def test_a_visitors_simulation_knows_whether_it_is_trusted(model, trusted):
    """The process that it is forked from was there before anybody said so."""
    prepare("madviz.app.session_maker")
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
