"""One contract for every environment: what has it can be trained on, evaluated and shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from madviz.envs import shapes
from madviz.envs.registry import (
    MANISKILL_TASKS,
    METAWORLD_TASKS,
    SETTINGS,
    TASKS,
    make_env,
    setting,
)
from madviz.errors import UserError
from madviz.types import Environment

CONTRACT_TASKS = (
    "toy/reach",
    "metaworld/hammer",
    "metaworld/push",
    "maniskill/push-cube",
    "maniskill/place-sphere",
    "madviz.examples.own_task:make",
)


@pytest.fixture(scope="module", params=CONTRACT_TASKS)
def env(request: pytest.FixtureRequest) -> Iterator[Environment]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MADVIZ_TASKS", "madviz.examples.own_task:make")
        made = make_env(request.param)
        yield made
        made.close()


def play(env: Environment, seed: int, decisions: int) -> list[np.ndarray]:
    """States and rewards of a seeded random episode."""
    rng, now = np.random.default_rng(seed), env.reset(seed)
    seen = [now.state]
    for _ in range(decisions):
        now = env.step(rng.uniform(-1, 1, env.spec.action_dim))
        seen += [now.state, np.array(now.reward)]
    return seen


def test_shapes_and_types(env: Environment) -> None:
    now = env.reset(0)
    assert now.state.shape == (env.spec.state_dim,) and now.state.dtype == np.float32
    assert not now.last
    for camera in env.spec.cameras:
        view = env.view(camera.name)
        assert view.rgb.shape == (camera.size, camera.size, 3) and view.rgb.dtype == np.uint8
        assert view.depth.shape == (camera.size, camera.size) and view.depth.dtype == np.float32
        assert view.depth.min() > 0
    expert = env.expert()
    assert expert.shape == (env.spec.action_dim,) and np.abs(expert).max() <= 1


def test_any_size_can_be_drawn(env: Environment) -> None:
    env.reset(0)
    large = env.view("third_a", 168)
    assert large.rgb.shape == (168, 168, 3)
    # The same picture, sharper. Coarse blocks, since the grain of wood differs pixel by pixel.
    blocks = [
        picture.rgb.reshape(21, edge, 21, edge, 3).mean((1, 3))
        for picture, edge in ((large, 8), (env.view("third_a", 84), 4))
    ]
    assert np.abs(blocks[0] - blocks[1]).mean() < 4


def test_a_seed_is_an_episode_whatever_came_before(env: Environment) -> None:
    first = play(env, 5, 8)
    picture = env.view("first").rgb
    play(env, 6, 3)
    np.random.seed(1)
    again = play(env, 5, 8)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert np.array_equal(picture, env.view("first").rgb)


def test_simulations_side_by_side_do_not_disturb_each_other(env: Environment) -> None:
    alone = play(env, 7, 5)
    other = make_env(env.spec.task)
    rng, now = np.random.default_rng(7), env.reset(7)
    beside = [now.state]
    other.reset(8)
    for _ in range(5):
        now = env.step(rng.uniform(-1, 1, env.spec.action_dim))
        beside += [now.state, np.array(now.reward)]
        other.step(np.zeros(env.spec.action_dim))
        other.view("third_b")
    other.close()
    assert all(np.array_equal(a, b) for a, b in zip(alone, beside, strict=True))


def test_different_seeds_are_different_scenes(env: Environment) -> None:
    env.reset(1)
    one = env.view("third_b").rgb
    env.reset(2)
    assert not np.array_equal(one, env.view("third_b").rgb)


def test_the_horizon_is_the_end(env: Environment) -> None:
    env.reset(0)
    still = np.zeros(env.spec.action_dim)
    lasts = [env.step(still).last for _ in range(env.spec.horizon)]
    assert lasts == [False] * (env.spec.horizon - 1) + [True]


def test_the_expert_succeeds_and_holds_it(env: Environment) -> None:
    ends = []
    for seed in range(3):
        now = env.reset(100 + seed)
        while not now.last:
            now = env.step(env.expert())
        ends.append(now.success)
    assert all(ends)


def test_cameras_are_where_their_poses_say(env: Environment) -> None:
    """The point in front of the lens, at the depth of the middle pixel, is on a surface that
    another camera's pose agrees with: here, above or on the table, or ManiSkill's floor."""
    env.reset(3)
    floor = -0.97 if env.spec.task.startswith("maniskill/") else -0.05
    for camera in env.spec.cameras:
        pose, view = env.pose(camera.name), env.view(camera.name)
        assert np.isclose(np.linalg.norm(pose.wxyz), 1, atol=1e-3)
        w, x, y, z = pose.wxyz
        forward = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        middle = view.depth[41:43, 41:43].mean()
        hit = pose.position + forward * middle
        assert floor < hit[2] < 0.5, f"{camera.name} sees {hit}"


def test_bodies_are_meshes_that_a_browser_can_draw(env: Environment) -> None:
    env.reset(3)
    scene = env.bodies()
    names = [body.name for body in scene]
    assert len(set(names)) == len(names) >= 3
    for part in (part for body in scene for part in body.parts):
        assert part.vertices.dtype == np.float32 and part.vertices.shape[1:] == (3,)
        assert part.faces.dtype == np.int32 and part.faces.shape[1:] == (3,)
        assert part.faces.min() >= 0 and part.faces.max() < len(part.vertices)
        assert part.colour.dtype == np.uint8 and part.colour.shape == (3,)
        assert np.isfinite(part.vertices).all() and np.abs(part.vertices).max() < 3
    assert sum(len(part.faces) for body in scene for part in body.parts) <= shapes.MOST
    env.step(np.zeros(env.spec.action_dim))
    assert env.bodies() is scene, "the same object while nothing changes"


def test_bodies_stand_in_the_world_and_move(env: Environment) -> None:
    env.reset(3)
    before = env.body_poses()
    assert before.shape == (len(env.bodies()), 7) and before.dtype == np.float32
    for _ in range(4):
        env.step(env.expert())
    after = env.body_poses()
    for poses in (before, after):
        assert np.isfinite(poses).all() and np.abs(poses[:, :3]).max() < 3
        np.testing.assert_allclose(np.linalg.norm(poses[:, 3:], axis=1), 1, atol=1e-4)
    moved = np.abs(after - before).max(1) > 1e-3
    assert 0 < moved.sum() < len(moved), "the hand moves, the table does not"


def test_the_hand_is_where_fingertips_are(env: Environment) -> None:
    env.reset(3)
    before = env.hand()
    assert before.shape == (3,) and before.dtype == np.float32
    assert np.abs(before[:2]).max() < 1.2 and 0 < before[2] < 0.6
    for _ in range(4):
        env.step(env.expert())
    went = env.hand() - before
    assert np.linalg.norm(went) > 0.01
    distances = np.linalg.norm(env.body_poses()[:, :3] - env.hand(), axis=1)
    assert distances.min() < 0.25, "some link of the gripper is near"


def test_a_moved_camera_sees_from_there_until_it_is_put_back(env: Environment) -> None:
    env.reset(4)
    own, camera = env.view("third_a"), env.spec.camera("third_a")
    to = replace(camera, position=(0.1, -0.2, 1.5), wxyz=(1.0, 0.0, 0.0, 0.0), fovy=50.0, body=None)
    env.move_camera("third_a", to)
    away, pose = env.view("third_a"), env.pose("third_a")
    np.testing.assert_allclose(pose.position, (0.1, -0.2, 1.5), atol=1e-6)
    np.testing.assert_allclose(np.abs(pose.wxyz), (0, 1, 0, 0), atol=1e-6)  # It looks down.
    assert pose.fovy == 50 and env.spec.camera("third_a") == camera
    assert np.abs(away.rgb.astype(int) - own.rgb).mean() > 5
    env.reset(4)
    assert np.array_equal(env.view("third_a").rgb, away.rgb), "a reset changes no camera"
    env.move_camera("third_a", replace(to, fovy=20.0))
    assert np.abs(env.view("third_a").rgb.astype(int) - away.rgb).mean() > 2, "it zooms"
    env.move_camera("third_a", None)
    back = env.view("third_a")
    assert np.array_equal(back.rgb, own.rgb) and np.array_equal(back.depth, own.depth)


def test_a_camera_is_not_moved_to_nowhere(env: Environment) -> None:
    env.reset(0)
    camera = env.spec.camera("third_a")
    for wrong, said in (
        (replace(camera, position=(np.nan, 0, 0)), "expected a place"),
        (replace(camera, wxyz=(0, 0, 0, 0)), "expected a place"),
        (replace(camera, fovy=170), "5 to 150 degrees"),
        (replace(camera, body="elbow"), "elbow"),
    ):
        with pytest.raises(UserError, match=said):
            env.move_camera("third_a", wrong)
    with pytest.raises(UserError, match="third_b"):
        env.move_camera("forth", None)
    assert env.pose("third_a").fovy == camera.fovy


@pytest.mark.parametrize("bad", [np.full(4, np.nan), np.zeros(5), np.full(4, np.inf)])
def test_a_broken_action_is_refused(env: Environment, bad: np.ndarray) -> None:
    env.reset(0)
    with pytest.raises(UserError, match="expected a finite action"):
        env.step(bad[: env.spec.action_dim] if np.isnan(bad).any() else bad)


def test_unknown_names_list_the_known_ones(env: Environment) -> None:
    with pytest.raises(UserError, match="third_b"):
        env.view("forth")
    with pytest.raises(UserError, match="metaworld/hammer"):
        make_env("metaworld/hamer")
    with pytest.raises(UserError, match="three-rgbd"):
        setting("thre")
    with pytest.raises(UserError, match="fast"):
        make_env("toy/reach", "shiny")


def test_settings_name_their_streams() -> None:
    assert SETTINGS["three"].streams == ("first", "third_a", "third_b")
    assert SETTINGS["three-rgbd"].streams[:2] == ("first.rgb", "first.depth")
    assert len(TASKS) == len(METAWORLD_TASKS) + len(MANISKILL_TASKS) + 1 == 21
