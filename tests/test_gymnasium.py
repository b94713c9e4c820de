"""madviz's tasks as Gymnasium knows them."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, Error, ResetNeeded
from gymnasium.utils.env_checker import check_env

from madviz.envs.gymnasium_env import MadvizEnv, ids, register
from madviz.envs.registry import TASKS, make_env
from madviz.system.depth import depth_code, depth_metres

ROOT = Path(__file__).resolve().parent.parent
QUICK = ("madviz/reach-v0", "madviz/hammer-v0")


def checked(name: str, **options) -> None:
    """Gymnasium's own checker; whatever it only warns of counts, too, but for what is meant: states
    have no bounds, and depth is float."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        env = gymnasium.make(name, **options)
        check_env(env.unwrapped, skip_render_check=False)
        env.close()
    ours = [str(one.message) for one in said if "WARN" in str(one.message)]
    meant = ("minimum value is -infinity", "maximum value is infinity", "render_mode")
    assert [one for one in ours if not any(word in one for word in meant)] == []


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("name", QUICK)
def test_gymnasiums_own_checker_is_content(name, flat):
    checked(name, flat=flat)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ids() if name not in QUICK])
def test_gymnasiums_own_checker_is_content_with_every_task(name):
    checked(name)


def test_every_task_has_a_name_and_importing_madviz_tells_gymnasium():
    assert sorted(ids().values()) == sorted(TASKS)
    register()
    assert all(name in gymnasium.registry for name in ids())
    program = "import gymnasium, madviz; print(gymnasium.make('madviz/reach-v0').reset(seed=1)[1])"
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT
    )
    assert "is_success" in found.stdout, found.stderr


def test_an_episode_is_the_one_of_its_seed_and_ends_at_its_horizon():
    env, world = gymnasium.make("madviz/reach-v0"), make_env("toy/reach")
    seen, info = env.reset(seed=5003)
    now, ended, steps = world.reset(5003), False, 0
    while not ended:
        np.testing.assert_array_equal(seen["agent_pos"], now.state.astype(np.float32))
        np.testing.assert_array_equal(seen["pixels"]["third_a"], world.view("third_a").rgb)
        # Depth has 256 steps from 0 to 2 m.
        there = world.view("first").depth
        np.testing.assert_allclose(seen["depth"]["first"][..., 0], there, atol=1.001 / 255)
        assert info["is_success"] == now.success
        action = np.array([0.5, -0.5], np.float32)
        seen, reward, terminated, ended, info = env.step(action)
        now, steps = world.step(action), steps + 1
        assert reward == now.reward and not terminated
    inner = env.unwrapped
    assert isinstance(inner, MadvizEnv) and steps == inner._max_episode_steps == 25
    assert inner.task_description == "Go to the orange target."


def test_pictures_have_the_size_that_is_asked_for_and_may_be_flat():
    env = MadvizEnv("toy/reach", size=48, depth=False, flat=True, render_mode="rgb_array")
    seen, _ = env.reset(seed=1)
    assert {name: part.shape for name, part in seen.items()} == {
        "first": (48, 48, 3),
        "third_a": (48, 48, 3),
        "third_b": (48, 48, 3),
        "agent_pos": (6,),
    }
    assert env.render().shape == (48, 144, 3)  # type: ignore[union-attr]


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_several_of_them_step_together(mode):
    options = {"context": "spawn"} if mode == "async" else {}
    many = gymnasium.make_vec(
        "madviz/reach-v0", 2, vectorization_mode=mode, vector_kwargs=options, depth=False
    )
    seen, _ = many.reset(seed=[3, 4])  # type: ignore[arg-type]
    assert seen["pixels"]["first"].shape == (2, 84, 84, 3)
    alone, _ = gymnasium.make("madviz/reach-v0").reset(seed=4)
    np.testing.assert_array_equal(seen["agent_pos"][1], alone["agent_pos"])
    seen, _, _, _, info = many.step(np.zeros((2, 2), np.float32))
    assert info["is_success"].shape == (2,)
    many.close()


def test_depth_is_what_a_policy_gets_and_its_range_is_the_cameras():
    env = MadvizEnv("metaworld/hammer", size=48, flat=True)
    seen, _ = env.reset(seed=5000)
    code = depth_code(env._world.view("third_a").depth, (0.5, 1.7))
    np.testing.assert_array_equal(seen["third_a_depth"], depth_metres(code, (0.5, 1.7)))
    assert env._world.view("third_a").depth.max() > 10
    space = env.get_wrapper_attr("observation_space")["third_a_depth"]
    assert (space.low.min(), space.high.max()) == (np.float32(0.5), np.float32(1.7))
    env.close()


def test_gymnasiums_own_errors_say_what_comes_first():
    with pytest.raises(Error, match="at least 1 pixel, found 0"):
        MadvizEnv("toy/reach", size=0)
    env = MadvizEnv("toy/reach", render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match="reset.. before step"):
        env.step(np.zeros(2, np.float32))
    with pytest.raises(ResetNeeded, match="reset.. before render"):
        env.render()
    env.reset(seed=1)
    env.close()
    env.close()
    for late in (lambda: env.step(np.zeros(2, np.float32)), env.render, env.reset):
        with pytest.raises(ClosedEnvironmentError, match="not closed"):
            late()


def test_forked_processes_are_refused_where_the_parent_has_drawn():
    """In a process of its own: whether something was drawn there holds until it ends."""
    program = (
        "import gymnasium, madviz, sys\n"
        "env = gymnasium.make('madviz/hammer-v0', size=16); env.reset(seed=1); env.close()\n"
        "many = gymnasium.make_vec('madviz/hammer-v0', 2, vectorization_mode='async', size=16)\n"
        "try:\n    many.reset(seed=[1, 2])\n"
        "except gymnasium.error.Error as error:\n    print('refused', error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, timeout=120
    )
    assert "refused" in done.stdout and '"context": "spawn"' in done.stdout, done.stderr
