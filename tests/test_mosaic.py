"""What arrives, drawn for the visitor: tiles, badges, and the picture of a dropped camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from madviz.app.panels.cameras import unused_note
from madviz.drawing.jpeg import jpeg, jpeg_url
from madviz.drawing.mosaic import GAP, HEADER, badge, mosaic
from madviz.observation.ablation import CameraState, Occlusion
from madviz.session.commands import SetCamera
from tests.fakes import policies
from tests.sessions import frame_with

OFF = CameraState("off")
TILE = 204


def tile(picture: np.ndarray, camera: int) -> np.ndarray:
    left = camera * (TILE + GAP)
    return picture[HEADER:, left : left + TILE].astype(int)


def test_a_tile_enlarges_what_arrives_pixel_by_pixel():
    frame = frame_with()
    picture = mosaic(frame, 3 * 84)
    assert picture.shape == (HEADER + 252, 3 * 252 + 2 * GAP, 3)
    np.testing.assert_array_equal(picture[HEADER::3, :252:3], frame.world.arrived["first"])


def test_dropped_black_and_intact_tiles_differ():
    intact = tile(mosaic(frame_with(), TILE), 1)
    dropped = tile(mosaic(frame_with(SetCamera("third_a", OFF)), TILE), 1)
    black_state = CameraState("rgb", Occlusion("black"))
    black = tile(mosaic(frame_with(SetCamera("third_a", black_state)), TILE), 1)
    assert np.ptp(intact, axis=2).mean() > 10
    assert np.ptp(dropped, axis=2).max() == 0, "a dropped camera has no colour"
    assert dropped.max() > 200, "and a stamp"
    assert black.max() == 0
    assert intact.mean() > 2 * dropped.mean()


def test_a_dropped_camera_shows_its_own_picture_not_its_occlusion():
    states = (CameraState("off"), CameraState("off", Occlusion("black")))
    left, right = (tile(mosaic(frame_with(SetCamera("first", s)), TILE), 0) for s in states)
    np.testing.assert_array_equal(left, right)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        (CameraState("rgb"), "RGB"),
        (OFF, "OFF"),
        (CameraState("rgb", Occlusion("freeze")), "FROZEN"),
        (CameraState("rgb", Occlusion("noise", 0.7)), "NOISE 70 %"),
        (CameraState("depth"), "DEPTH (NOT USED)"),
        (CameraState("both"), "RGB + DEPTH (NOT USED)"),
        (CameraState(occlusion=Occlusion("delay", 0.5)), "LATE BY 5"),
        (CameraState(occlusion=Occlusion("dropout", 0.5)), "LOSSY 50 %"),
    ],
)
def test_badges_say_the_state(state, words):
    assert badge(frame_with(SetCamera("first", state)), "first") == words


def test_both_modalities_share_a_tile_and_depth_has_a_scale_in_metres():
    frame = frame_with(policy=policies("toy-rgbd"))
    assert badge(frame, "third_b") == "RGB + DEPTH"
    picture = tile(mosaic(frame, TILE), 2)
    scale = picture[-10, 60:-60]
    assert len(np.unique(scale, axis=0)) > 30, "the bottom of the tile is a colour ramp"


def test_depth_under_an_rgb_policy_is_shown_and_said_to_be_unused():
    frame = frame_with(SetCamera("first", CameraState("depth")))
    assert frame.condition.subset == "third_a+third_b"
    assert "does not reach it" in unused_note(frame)
    assert unused_note(frame_with()) == ""
    assert unused_note(frame_with(policy=policies("toy-rgbd"))) == ""
    assert len(np.unique(tile(mosaic(frame, TILE), 0).reshape(-1, 3), axis=0)) > 2


@pytest.mark.parametrize("channels", [1, 3])
def test_a_jpeg_has_the_colours_of_its_picture(channels: int):
    picture = np.zeros((16, 24, channels), np.uint8)
    picture[..., 0] = 200
    found = cv2.imdecode(np.frombuffer(jpeg(picture), np.uint8), cv2.IMREAD_COLOR_RGB)
    assert found is not None and found.shape == (16, 24, 3)
    assert np.abs(found.astype(int) - picture).max() < 6
    assert jpeg_url(picture).startswith("data:image/jpeg;base64,/9j/")
