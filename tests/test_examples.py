"""Your own policies and tasks: the examples work as they say, and nobody else's code is run."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from madviz.envs.custom import allow_task, own_tasks
from madviz.envs.registry import choose, make_env
from madviz.errors import UserError
from madviz.examples.own_policy import Finder
from madviz.measure.evaluate import evaluate
from madviz.sweep.sweep_plan import read_plan
from madviz.training.config import TrainConfig
from madviz.training.light import LightConfig
from madviz.training.train import train
from madviz.types import Encoded

TOUCH = "madviz.examples.own_task:make"
FINDER = "madviz.examples.own_policy:make"


@pytest.fixture(autouse=True)
def nothing_named(monkeypatch):
    """No test leaves a name behind: the variable is put back, whoever changes it."""
    monkeypatch.setenv("MADVIZ_TASKS", "")


def write(folder: Path, name: str, *lines: str) -> str:
    (folder / f"{name}.py").write_text("\n".join(lines))
    return f"{name}:make"


# --- A policy ---


def test_features_add_up_as_the_example_says():
    features = np.array([[15, 6, 30], [1, 2, 10], [0, 0, 0]], np.float32)
    read = Finder().read(
        Encoded(features, np.array([0.4, 0.1], np.float32)),
        np.array([[1, 1, 0], [0, 0, 1]], bool),
    )
    assert read.merged[0].tolist() == [16, 8, 40]
    # The target (0.4, 0.2) is 0.1 m ahead in y; who sees nothing stays.
    assert np.allclose(read.action, [[0, 0.1 / 0.12], [0, 0]], atol=1e-6)


def test_the_example_finds_the_target_from_any_camera():
    rows = evaluate(FINDER, ["all", "third_a", "third_b", "none"], episodes=5, workers=0).rows
    assert [row["success"] for row in rows.values()] == [1, 1, 1, 0]


# --- A task ---


def test_a_task_of_ones_own_is_trained_on_and_evaluated_in_workers(tmp_path, monkeypatch):
    light = LightConfig(
        rounds=1, demonstrations=2, episodes_per_round=1, updates_per_round=2, batch_size=4,
        critic_updates=1, hidden_dim=16,
    )  # fmt: skip
    out = train(TrainConfig(task=TOUCH, out=tmp_path / "touch", light=light), lambda event: None)
    assert own_tasks() == (TOUCH,)
    rows = evaluate(out, ["all"], episodes=2, workers=1).rows
    assert rows["all"]["n"] == 2
    monkeypatch.setenv("MADVIZ_TASKS", "")
    with pytest.raises(UserError, match="nobody has named here"):
        evaluate(out, ["all"], episodes=3, workers=0)


def test_what_only_a_file_names_is_not_imported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    task = write(tmp_path, "not_mine", "raise SystemExit('this must not run')")
    sweep = tmp_path / "sweep.toml"
    sweep.write_text(f'[grid]\ntasks = ["{task}"]\nmethods = ["mad"]\n')
    for ask in (lambda: make_env(task), lambda: choose(task, "three"), lambda: read_plan(sweep)):
        with pytest.raises(UserError, match=f"nobody has named here.*MADVIZ_TASKS={task}"):
            ask()
    assert "not_mine" not in sys.modules


def test_tasks_are_allowed_by_the_variable_and_by_allow_task(monkeypatch):
    monkeypatch.setenv("MADVIZ_TASKS", " a:make ,, nonsense, b:make")
    allow_task("b:make")
    allow_task("metaworld/hammer")
    allow_task(None)
    assert own_tasks() == ("a:make", "b:make")
    allow_task("c:make")
    assert own_tasks() == ("a:make", "b:make", "c:make")


def test_the_error_for_what_is_no_environment_names_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parts = "reset = step = view = pose = move_camera = bodies = body_poses = hand = expert"
    for name, lines, said in (
        ("bare_1", ("def make(): return 3",), "found a int without spec, reset"),
        ("gone_1", ("import not_there_at_all",), "can be imported from here"),
        (
            "shell_1",
            ("class World:", f"    spec = {parts} = close = 0", "make = World"),
            "kind madviz.types.EnvSpec, found a int",
        ),
    ):
        task = write(tmp_path, name, *lines)
        allow_task(task)
        with pytest.raises(UserError, match=said):
            make_env(task)


def test_a_task_of_ones_own_keeps_its_cameras_and_its_profile(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    task = write(
        tmp_path,
        "renamed_1",
        "from dataclasses import replace",
        "from madviz.envs.toy import ToyReach",
        "built = 0",
        "def make():",
        "    global built",
        "    built += 1",
        "    world = ToyReach()",
        "    left, right = (replace(c, name=n) for c, n in zip(world.spec.cameras, 'lr'))",
        "    world.spec = replace(world.spec, cameras=(left, right))",
        "    return world",
    )
    allow_task(task)
    setting, cameras = choose(task, "three-rgbd")
    assert setting.streams == ("l.rgb", "l.depth", "r.rgb", "r.depth")
    with pytest.raises(UserError, match="no cameras for the setting 'five'"):
        choose(task, "five")
    assert choose(task, "three")[1] == cameras
    assert sys.modules["renamed_1"].built == 1, "to learn its cameras, and never again"
    sized = make_env(task, cameras=(replace(cameras[0], size=48),))
    assert [camera.size for camera in sized.spec.cameras] == [48, 84] and sized.spec.task == task
    for wrong in (replace(cameras[0], fovy=20.0), replace(cameras[0], name="x")):
        with pytest.raises(UserError, match=f"cameras l, r where they are.*'{wrong.name}'"):
            make_env(task, cameras=(wrong,))
    with pytest.raises(UserError, match="render profile 'fast' alone"):
        make_env(task, "full")
