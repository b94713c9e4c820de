"""Recordings as an environment: they go on as they were recorded, whatever the actions."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from madviz.envs.registry import choose, env_spec, known_tasks, make_env
from madviz.errors import UserError
from madviz.recorded.known import VARIABLE, allow_recording, refuse_recording
from madviz.recorded.moment import moment_of
from madviz.types import Environment
from tests.recordings import TASKS, Small, level

TASK = "recording/mine"


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Small:
    """The dataset that is known as ``TASK``."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(VARIABLE, "")
    written = Small()
    assert allow_recording(written.write(tmp_path / "mine")) == TASK
    return written


@pytest.fixture
def env(small: Small) -> Iterator[Environment]:
    made = make_env(TASK)
    yield made
    made.close()


def test_it_has_the_parts_of_an_environment(env: Environment) -> None:
    assert (env.spec.state_dim, env.spec.action_dim, env.spec.horizon) == (3, 3, 5)
    assert env.spec.recorded and [camera.label for camera in env.spec.cameras] == ["Top", "Wrist"]
    now = env.reset(1)
    assert now.state.shape == (3,) and now.state.dtype == np.float32 and not now.last
    for camera in env.spec.cameras:
        view = env.view(camera.name)
        assert view.rgb.shape == (84, 84, 3) and view.rgb.dtype == np.uint8
        assert view.depth.shape == (84, 84) and view.depth.min() > 0
        assert env.view(camera.name, 40).rgb.shape == (40, 40, 3)
        assert np.isclose(np.linalg.norm(env.pose(camera.name).wxyz), 1)
    assert env.bodies() == () and env.body_poses().shape == (0, 7) and env.hand().shape == (3,)
    assert np.abs(env.expert()).max() <= 1


def test_an_episode_goes_on_whatever_is_done(env: Environment, small: Small) -> None:
    played = []
    for push in (1.0, -1.0):
        now = env.reset(4)  # Four modulo three episodes: the second one.
        states = [now.state]
        for step in range(5):
            shown = env.view("top").rgb[30:54, 10:40]
            assert np.abs(shown.astype(int) - level(1, step)).max() <= 6
            moment = moment_of(env)
            assert moment is not None and moment.episode == 1 and moment.task == TASKS[1]
            now = env.step(np.full(3, push))
            assert (now.reward, now.success, now.last) == (0.0, False, step == 4)
            states.append(now.state)
        played.append(np.array(states))
    np.testing.assert_array_equal(played[0], played[1])
    training = small.states[:12]  # The last of three episodes is held out.
    low, high = training.min(0), training.max(0)
    scaled = 2 * (small.states[6:12] - low) / (high - low) - 1
    np.testing.assert_allclose(played[0], scaled, atol=1e-5)


def test_the_spread_is_that_of_scaled_actions(env: Environment, small: Small) -> None:
    actions = small.actions[:12]
    scaled = 2 * (actions - actions.min(0)) / (actions.max(0) - actions.min(0)) - 1
    np.testing.assert_allclose(env.spec.action_spread, scaled.std(0), rtol=1e-5)


def test_a_held_out_action_is_beyond_what_training_has(small: Small, tmp_path: Path) -> None:
    small.actions[12:] = 100
    small.rows["action"] = list(small.actions)
    env = make_env(allow_recording(small.write(tmp_path / "wide")))
    env.reset(2)
    moment = moment_of(env)
    assert moment is not None and moment.action.min() > 10 and env.expert().max() == 1


def test_a_recorded_camera_stays_where_it_stood(env: Environment) -> None:
    camera = env.spec.camera("top")
    env.move_camera("top", None)
    with pytest.raises(UserError, match="where they stood, found 'top' elsewhere"):
        env.move_camera("top", replace(camera, fovy=20.0))
    with pytest.raises(UserError, match="wrist"):
        env.move_camera("side", None)


def test_broken_actions_are_refused(env: Environment) -> None:
    env.reset(0)
    with pytest.raises(UserError, match="expected a finite action"):
        env.step(np.full(3, np.nan))


def test_its_settings_are_its_own_cameras(small: Small) -> None:
    setting, cameras = choose(TASK, "three")
    assert setting.cameras == ("top", "wrist") and len(cameras) == 2
    for name in ("three-rgbd", "one-rgbd", "mixed-resolution", "turned-away"):
        with pytest.raises(UserError, match="expected a setting without depth"):
            choose(TASK, name)
    with pytest.raises(UserError, match="no cameras for the setting 'five'"):
        choose(TASK, "five")


def test_only_named_recordings_are_known(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert TASK in known_tasks()
    with pytest.raises(UserError, match="unknown recording 'recording/main'; did you mean"):
        env_spec("recording/main")
    other = Small().write(tmp_path / "elsewhere/mine")
    with pytest.raises(UserError, match="a name of its own, found .*; rename one"):
        allow_recording(other)
    with pytest.raises(UserError, match="expected the folder"):
        allow_recording(tmp_path / "none")
    monkeypatch.setenv(VARIABLE, os.fspath(other))
    assert env_spec(TASK).task == TASK
    monkeypatch.chdir(other.parent)
    monkeypatch.setenv(VARIABLE, other.name)
    assert allow_recording(other) == TASK, "the same folder by another path"
    monkeypatch.setenv(VARIABLE, os.pathsep.join([str(other), str(tmp_path / "mine")]))
    with pytest.raises(UserError, match="a name of its own, found .*; rename one"):
        env_spec(TASK)


def test_counting_successes_is_refused_for_recordings() -> None:
    refuse_recording("toy/reach", "eval")
    with pytest.raises(UserError, match="expected a task in a simulator for eval, found rec"):
        refuse_recording(TASK, "eval")
