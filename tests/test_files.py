"""JSON for people, and files that are whole or not there."""

import json
import stat

import pytest

from madviz.files import LINE, pretty, read_json, write_bytes, write_json
from madviz.types import UserError

VALUES = {
    "short": {"a": [1, 2, {"b": None}], "c": "[\n { x"},
    "long list": [{"seed": n, "return": n / 3} for n in range(20)],
    "long text": ["x" * 200, "y"],
    "nothing": [{}, [], "", 0, True, None],
    "deep": {"a" * 50: {"b" * 50: {"c" * 50: [1.5e-9] * 40}}},
}


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_pretty_json_is_the_same_json(value):
    assert json.loads(pretty(value)) == value
    assert pretty(value).endswith("\n")


def test_what_fits_on_a_line_stays_on_one():
    lines = pretty({"episodes": [{"seed": n, "success": True} for n in range(9)]}).splitlines()
    assert lines[:3] == ["{", '  "episodes": [', '    {"seed": 0, "success": true},']
    assert max(map(len, lines)) < LINE


def test_json_has_no_nan(tmp_path):
    with pytest.raises(ValueError, match="Out of range float"):
        write_json(tmp_path / "x.json", {"loss": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_writing_replaces_the_whole_file_and_others_may_read_it(tmp_path):
    file = tmp_path / "x.json"
    write_bytes(file, b"0" * 10_000)
    write_json(file, [1])
    assert read_json(file) == [1] and stat.S_IMODE(file.stat().st_mode) == 0o644
    assert list(tmp_path.iterdir()) == [file]


def test_what_cannot_be_read_is_named(tmp_path):
    with pytest.raises(UserError, match="absent.json: expected a JSON file, found: No such file"):
        read_json(tmp_path / "absent.json")
