"""The conventions that a server says in its greeting: those that do not fit the file are named."""

from __future__ import annotations

from typing import Any

import pytest

from madviz.errors import UserError
from madviz.policies.checkpoint import load_policy
from tests.wires import foreign_server, towards_bright, wiring_file

HAMMER = {"task": '"metaworld/hammer"'}
POSITION = {"name": "position", "dims": 3, "format": "delta_xyz", "range": [-1, 1]}
GRIPPER = {"name": "gripper", "dims": 1, "format": "binary_close_positive"}
CLOSE_NEGATIVE = {**GRIPPER, "format": "binary_close_negative"}
IMAGE = {"name": "image", "dims": 0, "format": "rgb_hwc_uint8"}
STATE = {"name": "state", "dims": 24, "format": "raw"}


def load(folder: Any, says: dict[str, Any], file: dict[str, str]) -> object:
    with foreign_server(towards_bright, says=says) as address:
        return load_policy(f"{address}#wire={wiring_file(folder, **{**HAMMER, **file})}")


def said(action: dict[str, Any] | None = None, look: dict[str, Any] | None = None) -> dict:
    return {"action_spec": action or {}, "observation_spec": look or {}}


@pytest.mark.parametrize(
    ("says", "file", "expected"),
    [
        (
            said({"position": POSITION, "rotation": POSITION, "gripper": GRIPPER}),
            {},
            r"actions of 4 numbers for metaworld/hammer, found 7 \('position' of 3, 'rotation'",
        ),
        (
            said({"position": POSITION, "gripper": CLOSE_NEGATIVE}),
            {},
            "'gripper' as binary_close_positive, found binary_close_negative; say gripper_inv",
        ),
        (
            said({"position": POSITION, "gripper": GRIPPER}),
            {"gripper_inverted": "true"},
            "say gripper_inverted = false",
        ),
        (
            said({"position": POSITION, "gripper": GRIPPER}),
            {"action_sign": "[1, 1, 1, -1]"},
            "'gripper' as binary_clos",
        ),
        (
            said({"position": POSITION, "gripper": {**GRIPPER, "format": "continuous_01"}}),
            {},
            "'gripper' from -1 to 1, found continuous_01; map it in the server",
        ),
        (
            said({"position": {**POSITION, "format": "absolute_xyz"}, "gripper": GRIPPER}),
            {},
            "'position' as delta_xyz, found absolute_xyz; say absolute",
        ),
        (
            said({"position": POSITION, "gripper": GRIPPER}),
            {"absolute": "{ state = [16, 17, 18], step = 0.01 }"},
            "'position' as absolute_xyz, found delta_xyz; drop absolute",
        ),
        (said(look={"image": IMAGE}), {"channels": '"bgr"'}, "'image' as bgr, found 'rgb_hwc"),
        (said(look={"image": IMAGE}), {"values": '"0-1"'}, "'image' from 0 to 1, found 'rgb_hwc"),
        (
            said(look={"image": {**IMAGE, "format": "bgr_hwc_uint8"}}),
            {},
            "'image' as rgb, found 'bgr_hwc_uint8'; say channels",
        ),
        (said(look={"state": {**STATE, "dims": 8}}), {}, "a state of 24 numbers, found 8; see sta"),
        (said(look={"state": STATE}), {"state_order": "[0, 1]"}, "a state of 2 numbers, found 24"),
        (said(look={"state": STATE}), {"state": '""'}, "no state, found that the server takes one"),
        ({"action_spec": {"gripper": 3}}, {}, "action_spec"),
    ],
)
def test_a_convention_that_does_not_fit_is_refused_by_name(says, file, expected, tmp_path):
    with pytest.raises(UserError, match=expected) as refused:
        load(tmp_path, says, file)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("says", "file"),
    [
        (said({"position": POSITION, "gripper": GRIPPER}, {"image": IMAGE, "state": STATE}), {}),
        (said({"position": POSITION, "gripper": CLOSE_NEGATIVE}), {"gripper_inverted": "true"}),
        (said({"position": POSITION, "gripper": CLOSE_NEGATIVE}), {"action_sign": "[1, 1, 1, -1]"}),
        (
            said({"position": POSITION, "gripper": CLOSE_NEGATIVE}),
            {"task": '"maniskill/push-cube"'},
        ),
        (said({"actions": {"dims": 0, "format": "raw"}}, {"state": {"format": "raw"}}), {}),
        (said({"turn": {"dims": 4, "format": "a word that madviz does not know"}}), {}),
        ({"action_spec": None}, {}),
        ({}, {}),
    ],
)
def test_what_fits_or_says_nothing_is_served(says, file, tmp_path):
    assert load(tmp_path, says, file)
