"""From views to what the policy gets: depth code, stacks, occlusions that arrive frame by frame."""

from __future__ import annotations

import numpy as np
import pytest

from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.streams import StreamStack, stream_frame
from madviz.system.depth import depth_code
from madviz.types import View

THREE, RGBD = SETTINGS["three"].streams, SETTINGS["three-rgbd"].streams
SPEC = ToyReach().spec


def views(brightness: int, metres: float = 1.0) -> dict[str, View]:
    rgb = np.full((84, 84, 3), brightness, np.uint8)
    return {c: View(rgb, np.full((84, 84), metres, np.float32)) for c in THREE}


def newest_first(stack: StreamStack) -> list[int]:
    """The mean of each of the first stream's stacked frames, newest first."""
    return [round(stack.views[0, 3 * k].mean()) for k in (2, 1, 0)]


@pytest.mark.parametrize(("metres", "code"), [(-1, 0), (0.5, 0), (1.0, 106), (1.7, 255), (80, 255)])
def test_depth_is_coded_on_an_absolute_scale(metres: float, code: int) -> None:
    assert depth_code(np.array([[metres]]), (0.5, 1.7)).item() == code


def test_stacks_fill_at_the_start_and_then_roll() -> None:
    stack = StreamStack(SPEC, THREE)
    stack.push(views(10), Ablation(), 0, 0)
    assert stack.views.shape == (3, 9, 84, 84) and stack.views.dtype == np.uint8
    assert newest_first(stack) == [10, 10, 10]
    for step in (1, 2, 3):
        stack.push(views(10 + step), Ablation(), 0, step)
    assert newest_first(stack) == [13, 12, 11]
    stack.push(views(50), Ablation(), 1, 0)
    assert newest_first(stack) == [50, 50, 50]


def test_depth_streams_are_three_equal_channels() -> None:
    stack = StreamStack(SPEC, RGBD)
    stack.push(views(10, metres=0.5), Ablation(), 0, 0)
    depth = stack.views[1]
    assert np.all(depth == 64)  # The toy's range is 0 to 2 m.


def test_a_camera_fails_from_that_frame_on() -> None:
    black = Ablation({"first": CameraState(occlusion=Occlusion("black"))})
    stack = StreamStack(SPEC, THREE)
    stack.push(views(10), Ablation(), 0, 0)
    stack.push(views(11), black, 0, 1)
    assert newest_first(stack) == [0, 10, 10]
    stack.push(views(12), black, 0, 2)
    assert newest_first(stack) == [0, 0, 10]
    assert stack.views[1, 6].mean() == 12  # The other cameras go on.


def test_a_frozen_camera_keeps_the_picture_of_the_moment() -> None:
    freeze = Ablation({"first": CameraState(occlusion=Occlusion("freeze"))})
    stack = StreamStack(SPEC, THREE)
    stack.push(views(10), Ablation(), 0, 0)
    for step in (1, 2, 3):
        stack.push(views(20 + step), freeze, 0, step)
    assert newest_first(stack) == [10, 10, 10]
    stack.push(views(30), Ablation(), 0, 4)
    assert newest_first(stack) == [30, 10, 10]


def test_a_late_camera_sends_what_it_saw_then() -> None:
    late = Ablation({"first": CameraState(occlusion=Occlusion("delay", strength=0.4))})
    stack = StreamStack(SPEC, THREE)
    arrived = []
    for step in range(8):
        stack.push(views(10 + step), late, 0, step)
        arrived.append(newest_first(stack)[0])
        assert stack.newest["third_a"].mean() == 10 + step
    assert arrived == [10, 10, 10, 10, 10, 11, 12, 13]  # 0.4 x 10 = 4 decisions late.
    saved = stack.snapshot()
    stack.replace_last(Ablation())
    assert newest_first(stack) == [17, 12, 11]
    stack.push(views(90), Ablation(), 0, 8)
    stack.restore(saved)
    stack.push(views(18), late, 0, 8)
    assert newest_first(stack) == [14, 13, 12]


def test_what_was_seen_last_can_be_exchanged() -> None:
    stack = StreamStack(SPEC, THREE)
    for step in range(3):
        stack.push(views(10 + step), Ablation(), 0, step)
    stack.replace_view("first", views(50)["first"])
    stack.replace_last(Ablation())
    assert newest_first(stack) == [50, 11, 10]
    assert stack.newest["third_a"].mean() == 12


@pytest.mark.parametrize("step", [0, 1, 5])
def test_replacing_the_newest_is_as_if_it_had_been_so(step: int) -> None:
    noise = Ablation({"third_a": CameraState(occlusion=Occlusion("noise"))})
    changed, straight = StreamStack(SPEC, THREE), StreamStack(SPEC, THREE)
    for t in range(step + 1):
        last = t == step
        changed.push(views(10 + t), Ablation(), 4, t)
        straight.push(views(10 + t), noise if last else Ablation(), 4, t)
    changed.replace_last(noise)
    assert np.array_equal(changed.views, straight.views)
    changed.replace_last(Ablation())
    assert changed.views[1, 6].mean() == 10 + step


def test_a_camera_that_is_not_drawn_arrives_black() -> None:
    stack = StreamStack(SPEC, THREE)
    stack.push({"first": views(10)["first"]}, Ablation(), 0, 0)
    assert stack.views[0].any() and not stack.views[1:].any()


def test_other_resolutions_are_resized() -> None:
    large = View(np.full((96, 96, 3), 9, np.uint8), np.ones((96, 96), np.float32))
    assert stream_frame(large, "first", SPEC).shape == (84, 84, 3)
    assert stream_frame(large, "first.depth", SPEC).shape == (84, 84, 1)
