"""Camera settings, users' own cameras, and environments that draw what they are given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from madviz.envs.cameras import look_at, read_cameras
from madviz.envs.checks import resized_cameras
from madviz.envs.metaworld.environment import CAMERAS
from madviz.envs.placement import drawn_cameras
from madviz.envs.registry import (
    SETTINGS,
    choose,
    make_env,
    sees,
    setting,
    setting_cameras,
)
from madviz.errors import UserError
from madviz.observation.streams import IMAGE_SIZE, stream_frame
from madviz.types import CameraSpec

TASK = "metaworld/push"
GOOD = """
[[camera]]
name = "left"
position = [-0.7, 0.3, 0.6]
look_at = [0.0, 0.7, 0.1]
fovy = 55
size = 96

[[camera]]
name = "wrist"
label = "On the wrist"
position = [0.0, 0.1, 0.1]
wxyz = [1.0, 0.0, 0.0, 0.0]
body = "hand"
depth_range = [0.0, 0.5]
"""


def written(folder: Path, text: str) -> Path:
    file = folder / "cameras.toml"
    file.write_text(text)
    return file


def forward(camera: CameraSpec) -> np.ndarray:
    """(3,) where the camera looks."""
    return Rotation.from_quat(camera.wxyz, scalar_first=True).apply([0, 0, -1])


def test_every_setting_has_its_cameras_on_meta_world() -> None:
    for name, known in SETTINGS.items():
        cameras = setting_cameras(TASK, name)
        assert tuple(camera.name for camera in cameras) == known.cameras, name
    assert setting("one-rgbd").streams == ("third_a.rgb", "third_a.depth")
    assert setting("one-depth").streams == ("third_a.depth",)
    assert setting("one-rgb").streams == ("third_a",)
    assert setting("two").streams == ("first", "third_a")
    assert setting_cameras(TASK, "three") == CAMERAS


def test_an_environment_lists_and_draws_what_it_is_given() -> None:
    env = make_env(TASK, cameras=setting_cameras(TASK, "five"))
    env.reset(1)
    pictures = {camera.name: env.view(camera.name).rgb for camera in env.spec.cameras}
    env.close()
    assert list(pictures) == ["first", "third_a", "third_b", "third_c", "top"]
    flat = [picture.tobytes() for picture in pictures.values()]
    assert len(set(flat)) == 5 and all(picture.std() > 10 for picture in pictures.values())


def test_turned_away_cameras_see_the_same_nothing_whatever_happens() -> None:
    env = make_env(TASK, cameras=setting_cameras(TASK, "turned-away"))
    seen: dict[str, list[np.ndarray]] = {"first": [], "third_a": [], "third_b": []}
    for seed in (1, 2):
        env.reset(seed)
        for name, pictures in seen.items():
            pictures.append(env.view(name).rgb.astype(int))
    env.close()
    for name in ("first", "third_b"):
        assert seen[name][0].std() < 15, name
        assert np.abs(seen[name][0] - seen[name][1]).mean() < 1, name
    assert np.abs(seen["third_a"][0] - seen["third_a"][1]).max() > 30


@pytest.mark.parametrize("task", [TASK, "toy/reach"])
def test_mixed_resolutions_are_drawn_as_they_are_and_reach_a_policy_alike(task: str) -> None:
    env = make_env(task, cameras=setting_cameras(task, "mixed-resolution"))
    env.reset(1)
    views = {camera.name: env.view(camera.name) for camera in env.spec.cameras}
    env.close()
    assert [view.rgb.shape[0] for view in views.values()] == [64, 96, 84]
    assert [view.depth.shape[0] for view in views.values()] == [64, 96, 84]
    for name, view in views.items():
        for stream in (f"{name}.rgb", f"{name}.depth"):
            assert stream_frame(view, stream, env.spec).shape[:2] == (IMAGE_SIZE, IMAGE_SIZE)


def test_cameras_in_the_place_of_others_leave_the_rest_drawn_cameras() -> None:
    assert drawn_cameras(CAMERAS, ()) == CAMERAS
    one = setting_cameras(TASK, "one-rgb")
    assert drawn_cameras(CAMERAS, one) == CAMERAS
    larger = replace(CAMERAS[1], size=96)
    assert drawn_cameras(CAMERAS, (larger,)) == (CAMERAS[0], larger, CAMERAS[2])
    own = (CameraSpec("left", "Left", 60), CAMERAS[0])
    assert drawn_cameras(CAMERAS, own) == own


def test_whether_an_environment_draws_what_a_policy_needs() -> None:
    env = make_env("toy/reach")
    cameras = env.spec.cameras
    assert sees(env.spec, ()) and sees(env.spec, cameras[1:2])
    assert sees(env.spec, (replace(cameras[0], label="Another name"),))
    assert not sees(env.spec, (replace(cameras[0], size=64),))
    assert not sees(env.spec, (CameraSpec("left", "Left", 60),))


def test_the_toy_says_which_settings_it_has() -> None:
    for name in ("five", "turned-away"):
        with pytest.raises(UserError, match=f"no cameras for the setting '{name}'; .*three-rgbd"):
            setting_cameras("toy/reach", name)
    with pytest.raises(UserError, match="'third_b' placed elsewhere"):
        make_env("toy/reach", cameras=(CameraSpec("third_b", "Third B", 60),))
    with pytest.raises(UserError, match="unknown setting 'fiv'"):
        setting_cameras("toy/reach", "fiv")


def test_a_camera_looks_where_it_is_told_to_and_stays_upright() -> None:
    for position, target in (
        ((1, 2, 3), (0, 0, 0)),
        ((0, 0, 1), (0, 0, 0)),
        ((0, 0, 0), (0, 1, 0)),
    ):
        wxyz = look_at(position, target)
        ahead = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
        turn = Rotation.from_quat(wxyz, scalar_first=True)
        assert np.allclose(turn.apply([0, 0, -1]), ahead, atol=1e-5)
        assert abs(turn.apply([1, 0, 0])[2]) < 1e-5  # The picture's rows are level.
    assert np.allclose(Rotation.from_quat(look_at((0, 0, 1), (0, 0, 0)), scalar_first=True).apply(
        [0, 1, 0]), [0, 1, 0], atol=1e-5)  # fmt: skip


def test_a_users_cameras_are_read_drawn_and_placed(tmp_path: Path) -> None:
    _, cameras = choose(TASK, "three", written(tmp_path, GOOD))
    left, wrist = cameras
    assert (left.label, left.size, left.fovy) == ("Left", 96, 55.0)
    assert np.allclose(forward(left), np.array([0.7, 0.4, -0.5]) / np.sqrt(0.9), atol=1e-5)
    assert (wrist.label, wrist.body, wrist.depth_range) == ("On the wrist", "hand", (0.0, 0.5))
    env = make_env(TASK, cameras=cameras)
    env.reset(1)
    assert [camera.name for camera in env.spec.cameras] == ["left", "wrist"]
    assert env.view("left").rgb.shape == (96, 96, 3) and env.view("left").rgb.std() > 10
    assert np.allclose(env.pose("left").position, (-0.7, 0.3, 0.6))
    before = env.pose("wrist").position
    for _ in range(5):
        env.step(np.array([0, 0, 1, 0]))
    assert env.pose("wrist").position[2] > before[2] + 0.02
    env.close()


def test_own_cameras_come_in_the_modalities_of_the_setting(tmp_path: Path) -> None:
    streams = choose(TASK, "three-rgbd", written(tmp_path, GOOD))[0].streams
    assert streams == ("left.rgb", "left.depth", "wrist.rgb", "wrist.depth")
    assert choose(TASK, "five") == (setting("five"), setting_cameras(TASK, "five"))


def test_a_file_may_change_the_size_of_a_camera_that_stays_where_it_is(tmp_path: Path) -> None:
    file = tmp_path / "cameras.toml"
    file.write_text(
        '[[camera]]\nname = "third_a"\nposition = [0, 0, 2.2]\n'
        "wxyz = [0.92388, 0, 0, 0.382683]\nsize = 64\n"
    )
    (given,) = read_cameras(file)
    own = make_env("toy/reach").spec.cameras
    found = resized_cameras("toy/reach", own, (given,))
    expected = [replace(one, size=64) if one.name == "third_a" else one for one in own]
    assert list(found) == expected, "with its own label and numbers"
    with pytest.raises(UserError, match="'third_a' placed elsewhere"):
        resized_cameras("toy/reach", own, (replace(given, position=(0, 0.01, 2.2)),))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("fovy = 55", "fov = 55", "camera 1: unknown word 'fov'; did you mean fovy. known: .*fovy"),
        ("fovy = 55", 'fovy = "wide"', "camera 1: expected 'fovy' to be a number, found 'wide'"),
        ("fovy = 55", "fovy = 155", "'fovy' to be a number <= 150.0, found 155"),
        ("size = 96", "size = 96.5", "expected 'size' to be a whole number, found 96.5"),
        ("size = 96", "size = 9600", "'size' to be a whole number <= 512, found 9600"),
        ('name = "left"', 'name = "Left side"', "small letters, digits and _, found 'Left side'"),
        ('name = "left"', 'name = "all"', "expected another name than 'all', which is a subset's"),
        ('name = "left"', "", "camera 1: expected 'name', found none"),
        ('name = "left"', 'name = "wrist"', "two cameras 'wrist'"),
        ("[-0.7, 0.3, 0.6]", "[-0.7, 0.3]", r"'position' to be a list of length 3, found \[-0.7"),
        ("[-0.7, 0.3, 0.6]", "[0.0, 0.7, 0.1]", "expected look_at apart from position"),
        ("[-0.7, 0.3, 0.6]", "[nan, 0.7, 0.1]", r"'position\[0\]' to be a number .*, found nan"),
        ("look_at = [0.0, 0.7, 0.1]", "", "expected either wxyz or look_at, found neither"),
        ("[1.0, 0.0, 0.0, 0.0]", "[1.0, 1.0, 0.0, 0.0]", "camera 2: .*norm 1, .*found norm 1.41"),
        ("[0.0, 0.5]", "[0.5, 0.0]", r"expected depth_range = \[near, far\].*found \[0.5, 0.0\]"),
        ("[[camera]]", "[[cameras]]", "unknown word 'cameras'; did you mean camera"),
        ("fovy = 55", "fovy = ", "expected TOML, found: .*line 6"),
        ("fovy = 55", "fovy = 55\nfovy = 56", "expected TOML, found: .*overwrite"),
    ],
)
def test_mistakes_in_a_camera_file_are_told_in_one_line(
    tmp_path: Path, old: str, new: str, expected: str
) -> None:
    assert old in GOOD
    with pytest.raises(UserError, match=expected) as error:
        read_cameras(written(tmp_path, GOOD.replace(old, new)))
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_and_a_body_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a camera file, found: No such file"):
        read_cameras(tmp_path / "none.toml")
    with pytest.raises(UserError, match="expected 'camera' to be a list of length <= 8, found"):
        read_cameras(written(tmp_path, 5 * GOOD))
    with pytest.raises(UserError, match="expected 'camera', found none"):
        read_cameras(written(tmp_path, ""))
    cameras = read_cameras(written(tmp_path, GOOD.replace('"hand"', '"hnad"')))
    with pytest.raises(UserError, match="unknown body of the camera wrist 'hnad'; .*known.*hand"):
        make_env(TASK, cameras=cameras)
