"""What is in integrations/ works in the environments that its setup.sh make, where they are."""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
import tomllib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from madviz.envs.registry import make_env
from madviz.examples import own_policy
from madviz.recorded.films import letterboxed
from madviz.recorded.recordings import open_recordings
from madviz.recording.lerobot import expert_decisions
from madviz.serving.serve import PolicyServer
from madviz.wire.wiring import env_of, read_wiring

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "integrations"


def python_of(name: str) -> Path:
    """The interpreter of an environment: MADVIZ_VLA_EVAL=FILE, or where setup.sh makes it."""
    usual = FOLDER / name / ".venv" / "bin" / "python"
    return Path(os.environ.get(f"MADVIZ_{name.upper()}", usual))


def needs(name: str) -> pytest.MarkDecorator:
    said = f"integrations/{name}/setup.sh makes its environment"
    return pytest.mark.skipif(not python_of(name).exists(), reason=said)


def ran(words: list[str | Path], folder: Path) -> str:
    """What a program prints."""
    paths = os.pathsep.join([str(ROOT), str(folder), str(FOLDER / "lerobot_env_madviz")])
    kept = {**os.environ, "PYTHONPATH": paths, "HF_HUB_OFFLINE": "1"}
    found = subprocess.run(words, cwd=folder, env=kept, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    return found.stdout + found.stderr


@pytest.fixture
def served() -> Iterator[str]:
    """The address of the example policy."""
    server = PolicyServer(own_policy.make()).start()
    yield server.address
    server.close()


@pytest.mark.slow
@needs("vla_eval")
def test_vla_evals_harness_evaluates_a_served_policy(served: str, tmp_path: Path) -> None:
    harness = python_of("vla_eval").with_name("vla-eval")
    options = ["--no-docker", "--yes", "--render", "cpu", "--config", "reach.yaml"]
    where = ["--server-url", served, "--output-dir", tmp_path]
    said = ran([harness, "run", *options, *where], FOLDER / "vla_eval")
    assert "100.0% (5/5)" in said and "Spec validation passed" in said


@pytest.mark.slow
@needs("openpi")
@pytest.mark.parametrize("drop", [[], ["--drop", "first", "third_a"]])
def test_openpis_client_plays_with_a_served_policy(served: str, drop: list[str]) -> None:
    port = served.rpartition(":")[2]
    words = [python_of("openpi"), "play.py", "--port", port, "--episodes", "3", *drop]
    said = ran(words, FOLDER / "openpi")
    assert "served: finder" in said and "3 of 3 successful" in said


@pytest.mark.slow
@needs("lerobot")
def test_lerobot_makes_environments_of_madvizs_tasks() -> None:
    program = (
        "import lerobot_env_madviz\n"
        "from lerobot.envs.factory import make_env, make_env_config\n"
        "from lerobot.envs.utils import preprocess_observation\n"
        "config = make_env_config('madviz', task='reach-v0')\n"
        "env = make_env(config, n_envs=2)['madviz'][0]\n"
        "seen, _ = env.reset(seed=[5000, 5001])\n"
        "batch = preprocess_observation(seen)\n"
        "print(sorted(config.features_map.values()), env.call('task_description'))\n"
        "print({k: tuple(v.shape) for k, v in batch.items()})\n"
    )
    said = ran([python_of("lerobot"), "-c", program], FOLDER / "lerobot")
    assert "'observation.images.third_b': (2, 3, 84, 84)" in said
    assert "'action', 'observation.images.first'" in said and "Go to the orange target." in said


@pytest.mark.slow
@needs("lerobot")
@pytest.mark.parametrize(
    ("case", "said"),
    [
        ("plain", ""),
        ("ensembling", ""),
        ("no preprocessor", "expected the processors that LeRobot saves.*policy_preprocessor.json"),
        ("renamed action", "statistics action.mean, action.std, found actions.mean, actions.std"),
        ("renamed state", "statistics observation.state.mean, observation.state.std, found"),
        ("no normaliser", "a step that normalises observation.images.first by MEAN_STD"),
        ("shapes", "images.first as a square.*found 48 by 64; say --letterbox"),
    ],
)
def test_a_policy_of_lerobot_acts_as_there_or_is_refused(
    case: str, said: str, tmp_path: Path
) -> None:
    found = acted(tmp_path, case)
    if said:
        assert re.search(said, found["refused"]) and "\n" not in found["refused"]
    else:
        assert found["difference"] <= 1e-5 < found["spread"]
        assert found["outside"] == found["outside there"] > 0
        assert found["chunk"] == (1 if case == "ensembling" else 5)


@pytest.mark.slow
@needs("lerobot")
def test_each_camera_of_lerobot_has_its_own_height_and_width(tmp_path: Path) -> None:
    found = acted(tmp_path, "shapes boxed")
    assert found["size"] == {"first": [48, 64], "third_a": [40, 40], "third_b": [56, 56]}
    assert found["boxed"] and found["action"] == 2
    assert "'first' as 48 by 64 pixels" in found["refused"] and "64 by 64" in found["refused"]


def acted(folder: Path, case: str) -> dict[str, Any]:
    words = [python_of("lerobot"), "check_acts.py", folder / "act", case]
    said = ran(words, FOLDER / "lerobot").splitlines()
    return json.loads(next(line for line in said if line.startswith("{")))


@pytest.mark.slow
@needs("lerobot")
def test_pictures_and_states_are_those_of_lerobots_own_meta_world(tmp_path: Path) -> None:
    seeds = range(5000, 5005)
    words = [python_of("lerobot"), "check_metaworld.py", tmp_path / "there.npz"]
    ran([*words, "hammer", *map(str, seeds)], FOLDER / "lerobot")
    there = np.load(tmp_path / "there.npz")
    with closing(make_env("lerobot/hammer", "full")) as env:
        columns = (there[name] for name in ("actions", "states", "pictures"))
        for seed, actions, states, pictures in zip(seeds, *columns, strict=True):
            here = [env.reset(seed).state]
            seen = [env.view("third_a", 480).rgb]
            for step, action in enumerate(actions, 1):
                here.append(env.step(action).state)
                if step in there["drawn"]:
                    seen.append(env.view("third_a", 480).rgb)
            np.testing.assert_allclose(here, states, atol=1e-6)
            apart = np.abs(np.array(seen, int) - pictures)
            assert apart.mean() < 0.01 and (apart > 0).mean() < 1e-3, "some pixels at edges"


def test_the_wire_file_of_lerobots_meta_world_is_complete() -> None:
    wiring = read_wiring(FOLDER / "lerobot" / "metaworld.toml")
    assert (wiring.streams, wiring.shape_of("third_a")) == (("third_a",), (480, 480))
    env = env_of(wiring)
    assert (env.task, env.render_profile, env.state_dim) == ("lerobot/hammer", "full", 4)
    assert env.action_repeat == 1


def test_lerobot_finds_the_plug_in_by_its_name() -> None:
    project = tomllib.loads((FOLDER / "lerobot_env_madviz" / "pyproject.toml").read_text())
    assert project["project"]["name"] == "lerobot_env_madviz"
    assert (FOLDER / "lerobot_env_madviz" / "lerobot_env_madviz" / "__init__.py").exists()


SCRIPTS = sorted([*FOLDER.glob("*.sh"), *FOLDER.glob("*/setup.sh")])


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: f"{script.relative_to(FOLDER)}")
def test_a_setup_script_can_be_read_by_bash(script: Path) -> None:
    assert os.access(script, os.X_OK)
    subprocess.run(["bash", "-n", script], check=True)


@pytest.mark.slow
@needs("lerobot")
@pytest.mark.parametrize("codec", ["h264", "libsvtav1", "images"])
def test_recordings_are_read_as_lerobots_own_loader_reads_them(
    codec: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ["check_recordings.py", tmp_path / "set", codec, tmp_path / "there.npz"]
    ran([python_of("lerobot"), *words], FOLDER / "lerobot")
    there = np.load(tmp_path / "there.npz")
    found = open_recordings(tmp_path / "set")
    assert found.left_out == () and len(found.episodes) == 3
    began = time.perf_counter()
    frames = [found.frames(one.index, 84) for one in found.episodes]
    seconds = time.perf_counter() - began
    print(f"{codec}: decoded in {seconds:.2f} s, by LeRobot's loader in {there['seconds']:.2f} s")
    for one, shown in zip(found.episodes, frames, strict=True):
        rows = there["episode_index"] == one.index
        states, actions = found.numbers(one.index)
        np.testing.assert_array_equal(states, there["observation.state"][rows])
        np.testing.assert_array_equal(actions, there["action"][rows])
        assert set(there["tasks"][rows]) == {one.task}
        for number, camera in enumerate(found.cameras):
            expected = [letterboxed(picture, 84) for picture in there[camera.key][rows]]
            assert np.abs(shown[:, number].astype(int) - np.array(expected)).max() <= 1


@pytest.mark.slow
@needs("lerobot")
def test_lerobots_writer_keeps_what_the_script_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ["write_recordings.py", "toy/reach", tmp_path / "set", "--episodes", "2", "--seed", "3"]
    ran([python_of("lerobot"), *words], FOLDER / "lerobot")
    found = open_recordings(tmp_path / "set")
    assert [(one.height, one.width) for one in found.cameras] == [(240, 320)] * 3
    for number, one in enumerate(found.episodes):
        env = make_env("toy/reach")
        steps = list(expert_decisions(env, ("first", "third_a", "third_b"), 0.0, 3 + number))
        states, actions = found.numbers(one.index)
        np.testing.assert_array_equal(states, [step.state for step in steps])
        np.testing.assert_array_equal(actions, [step.action for step in steps])
        drawn = steps[-1].pictures["third_a"]  # (84, 84, 3), where the film has black bars.
        shown = found.frames(one.index, 84)[-1, 1]
        squeezed = cv2.resize(drawn, (84, 63), interpolation=cv2.INTER_AREA)
        assert np.abs(shown[10:73].astype(int) - squeezed).mean() < 12
    assert len(found.episodes) == 2


@pytest.mark.slow
@needs("lerobot")
def test_a_training_of_act_does_not_go_on_with_other_options(tmp_path: Path) -> None:
    (tmp_path / "training.json").write_text('{"data": "mine", "leave_out": "[3]", "updates": "9"}')
    words = [python_of("lerobot"), "train_act.py", "--data", "mine", "--out", tmp_path]
    found = subprocess.run(words, cwd=FOLDER / "lerobot", capture_output=True, text=True)
    assert found.returncode == 1 and "expected --leave-out [3], with which" in found.stderr
