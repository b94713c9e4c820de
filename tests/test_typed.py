"""What a file holds against its type: a mistake is one line."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from madviz.errors import UserError
from madviz.system.typed import typed
from madviz.types import CameraSpec


class Scene(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    cameras: tuple[CameraSpec, ...] = ()
    scale: float | None = None


CAMERA = {"name": "first", "label": "First", "fovy": 60}
MISTAKES = [
    ([], "expected a table of named values, found []"),
    ({}, "expected 'name', found none"),
    ({"name": 3}, "expected 'name' to be a text, found 3"),
    ({"name": "a", "scale": "big"}, "expected 'scale' to be a number or nothing, found 'big'"),
    ({"name": "a", "scal": 1}, "unknown word 'scal'; did you mean scale"),
    (
        {"name": "a", "cameras": [{**CAMERA, "fovy": "wide"}]},
        r"expected 'cameras\[0\].fovy' to be a number, found 'wide'",
    ),
    (
        {"name": "a", "cameras": [{**CAMERA, "position": [1]}]},
        r"expected 'cameras\[0\].position' to be a list of length 3, found \[1\]",
    ),
    ({"name": "a", "cameras": [{"name": "b"}]}, r"expected 'cameras\[0\].label', found none"),
]


@pytest.mark.parametrize(("value", "message"), MISTAKES, ids=[m for _, m in MISTAKES])
def test_a_mistake_is_one_line_with_place_and_next_move(value: Any, message: str) -> None:
    with pytest.raises(UserError, match=message.replace("[]", r"\[\]")) as error:
        typed(value, Scene, "scene.json", "restore the file")
    text = str(error.value)
    assert text.startswith("scene.json: ") and text.endswith("; restore the file")
    assert "\n" not in text


def test_lists_become_tuples_and_whole_numbers_may_stand_for_others() -> None:
    found = typed({"name": "a", "cameras": [CAMERA], "scale": 2}, Scene, "scene.json", "")
    assert found.cameras == (CameraSpec("first", "First", 60),) and found.scale == 2.0
