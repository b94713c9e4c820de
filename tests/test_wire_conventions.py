"""The words of a wire file for how numbers are meant: each with its inverse, and its refusals."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from madviz.errors import UserError
from madviz.policies.checkpoint import load_policy
from madviz.wire.conventions import AXES
from madviz.wire.wiring import Wiring, as_written, checked, env_of, read_wiring
from tests.wires import foreign_server, wiring_file


def wired(task: str = "maniskill/pick-cube", **words: Any) -> Wiring:
    table = {"task": task, "cameras": {"first": "f", "third_a": "a"}, "size": 84, "state": "s"}
    return checked(msgspec.convert({**table, "masks": True, **words}, Wiring), "here")


PICTURE = np.random.default_rng(0).integers(0, 256, (6, 8, 9), np.uint8)


@pytest.mark.parametrize("flip", AXES)
def test_a_turned_picture_turned_again_is_the_picture(flip):
    sent = wired(flip=flip).sent_picture(PICTURE, "first", True)
    assert (flip == "none") == np.array_equal(sent, PICTURE)
    np.testing.assert_array_equal(np.flip(sent, AXES[flip]), PICTURE)


def test_what_is_turned_is_what_the_word_says():
    sent = wired(flip="upside-down").sent_picture(PICTURE, "first", True)
    np.testing.assert_array_equal(sent[0], PICTURE[-1])
    words = wired(flip={"third_a": "mirrored"})
    np.testing.assert_array_equal(words.sent_picture(PICTURE, "first", True), PICTURE)
    np.testing.assert_array_equal(
        words.sent_picture(PICTURE, "third_a", True)[:, 0], PICTURE[:, -1]
    )


def test_blue_comes_first_in_every_frame_and_depth_stays():
    words = wired(channels="bgr")
    sent = words.sent_picture(PICTURE, "first", True)
    np.testing.assert_array_equal(sent, PICTURE[..., [2, 1, 0, 5, 4, 3, 8, 7, 6]])
    np.testing.assert_array_equal(words.sent_picture(sent, "first", True), PICTURE)
    np.testing.assert_array_equal(words.sent_picture(PICTURE, "first", False), PICTURE)


def test_a_picture_from_0_to_1_times_255_is_the_picture():
    sent = wired(values="0-1").sent_picture(PICTURE, "first", True)
    assert sent.dtype == np.float32 and 0 <= sent.min() and sent.max() <= 1
    np.testing.assert_array_equal(np.rint(sent * 255).astype(np.uint8), PICTURE)


def test_the_state_that_is_sent_can_be_put_back():
    order = np.random.default_rng(1).permutation(29)
    scale = np.linspace(0.5, 1000, 29)
    words = wired(state_order=order.tolist(), state_scale=scale.tolist(), state_degrees=True)
    env = env_of(words)
    state = np.linspace(-1, 1, 29).astype(np.float32)
    before = state.copy()
    sent = words.sent_state(state, env)
    np.testing.assert_array_equal(state, before)
    back = (sent / scale)[np.argsort(order)]
    angles = list(env.state_numbers.angles)
    back[angles] = np.radians(back[angles])
    np.testing.assert_allclose(back, state, atol=1e-6)
    assert angles[0] == 0 and 7 not in angles, "joints are angles, fingers are not"


def test_some_of_the_state_can_be_sent():
    words = wired("metaworld/hammer", state_order=[16, 17, 18, 19], state_scale=1000.0)
    state = np.arange(24, dtype=np.float32)
    sent = words.sent_state(state, env_of(words))
    assert sent.tolist() == [16000, 17000, 18000, 19000] and sent.dtype == np.float32


def test_an_answer_is_the_action_that_it_was_made_of():
    order = [2, 0, 3, 1]
    sign = [1, -1, 1, 1]
    scale = [0.5, 2.0, 10.0, 1.0]
    words = wired(action_order=order, action_sign=sign, action_scale=scale, gripper_inverted=True)
    action = np.array([0.1, -0.2, 0.3, -1.0], np.float32)
    theirs = np.zeros(4, np.float32)
    theirs[order] = action * [1, 1, 1, -1] * np.array(sign) / scale
    kept = theirs.copy()
    found = words.own_action(theirs, np.zeros(29, np.float32), env_of(words))
    np.testing.assert_allclose(found, action, atol=1e-6)
    np.testing.assert_array_equal(theirs, kept)


def test_a_place_is_the_way_to_it_from_where_the_hand_is_by_then(tmp_path):
    """The second decision of a chunk begins elsewhere than the first one."""

    def answer(look: dict[str, Any], connection: object) -> dict[str, Any]:
        return {"actions": np.array([[0.5, 0.3], [0.5, 0.3]])}

    words = {"chunk": "2", "absolute": "{ state = [4, 5], step = 0.1 }"}
    with foreign_server(answer) as address:
        policy = load_policy(f"{address}#wire={wiring_file(tmp_path, **words)}")
        player = policy.reset(0)  # type: ignore[attr-defined]
        views, mask = np.zeros((2, 9, 84, 84), np.uint8), np.ones(2, bool)
        for hand, way in (((0.45, 0.25), (0.5, 0.5)), ((0.5, 0.4), (0.0, -1.0))):
            state = np.array([9, 9, 9, 9, *hand], np.float32)
            action = player.act(policy.encode(views, state), mask)
            np.testing.assert_allclose(action, way, atol=1e-5)
            read = policy.read(policy.encode(views, state), mask[None]).action[0]
            np.testing.assert_allclose(read, way, atol=1e-5)
        player.close()


def test_a_picture_is_stretched_where_the_file_says_so(tmp_path):
    looks: list[dict[str, Any]] = []

    def answer(look: dict[str, Any], connection: object) -> dict[str, Any]:
        looks.append(look["images"])
        return {"actions": np.zeros(2)}

    with foreign_server(answer) as address:
        file = wiring_file(tmp_path, size="[48, 64]", stretch="true")
        policy = load_policy(f"{address}#wire={file}")
        views = np.full((2, 9, 48, 48), 200, np.uint8)
        policy.read(policy.encode(views, np.zeros(6, np.float32)), np.ones((1, 2), bool))
    assert looks[0]["wrist"].shape == (48, 64, 9) and (looks[0]["wrist"] == 200).all()


REFUSED: list[tuple[dict[str, str], str]] = [
    ({"flip": '"sideways"'}, "flip"),
    ({"flip": '{ left = "mirrored" }'}, r"unknown camera in \[flip\] 'left'"),
    ({"channels": '"rbg"'}, "channels"),
    ({"channels": '"bgr"', "modality": '"depth"'}, "a camera in colour, found depth alone"),
    ({"values": '"0-2"'}, "values"),
    ({"letterbox": "true", "stretch": "true"}, "'letterbox' or 'stretch', found both"),
    ({"state_order": "[0, 0]"}, "'state_order' to be numbers from 0 to 5, each once"),
    ({"state_order": "[6]"}, "'state_order' to be numbers from 0 to 5, each once"),
    ({"state_scale": "[1.0, 2.0]"}, "'state_scale' to be 6 numbers, found 2"),
    ({"state_order": "[1, 2]", "state_scale": "[1.0]"}, "'state_scale' to be 2 numbers, found 1"),
    ({"state_scale": "0.0"}, "state_scale"),
    ({"state_scale": "nan"}, "state_scale"),
    ({"state_degrees": "true"}, "toy/reach, whose state has none"),
    ({"state": '""', "state_scale": "2.0"}, "'state_scale' beside a state, found that none"),
    ({"state": '""', "state_order": "[1]"}, "'state_order' beside a state, found that none"),
    ({"action_order": "[0]"}, "'action_order' to be 2 numbers, found 1"),
    ({"action_order": "[1, 2]"}, "'action_order' to be numbers from 0 to 1"),
    ({"action_sign": "[1]"}, "'action_sign' to be 2 numbers, found 1"),
    ({"action_sign": "[1, 2]"}, "action_sign"),
    ({"action_scale": "-1.0"}, "action_scale"),
    ({"action_scale": "[1.0, 1.0, 1.0]"}, "'action_scale' to be 2 numbers, found 3"),
    ({"gripper_inverted": "true"}, "'gripper_inverted' for a task with a gripper, found toy"),
    ({"absolute": "{ state = [6], step = 0.1 }"}, "'absolute.state' to be numbers from 0 to 5"),
    ({"absolute": "{ state = [1, 2, 3], step = 1 }"}, "'absolute.state' to be 2 numbers at most"),
    ({"absolute": "{ state = [1], step = 0 }"}, "absolute.step"),
    ({"turned": "true"}, "turned"),
    (
        {
            "task": '"metaworld/hammer"',
            "gripper_inverted": "true",
            "action_sign": "[1, 1, 1, -1]",
        },
        "the gripper to be inverted once",
    ),
]


@pytest.mark.parametrize(("changed", "said"), REFUSED)
def test_words_that_make_no_sense_are_refused_when_the_file_is_read(changed, said, tmp_path):
    with pytest.raises(UserError, match=said) as refused:
        read_wiring(wiring_file(tmp_path, **changed))
    assert "\n" not in str(refused.value) and "wire.toml" in str(refused.value)


def test_words_that_are_not_said_are_not_sent_to_older_versions():
    plain = set(as_written(wired()))
    assert not plain & {"flip", "stretch", "letterbox", "state_order", "absolute", "action_scale"}
    said = as_written(wired(flip="mirrored", action_scale=2.0))
    assert set(said) == plain | {"flip", "action_scale"}
