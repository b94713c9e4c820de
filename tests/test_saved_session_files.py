"""Saved sessions that come as files from anybody are checked."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from madviz.errors import UserError
from madviz.observation.ablation import CameraState, Occlusion
from madviz.session.commands import (
    SetCamera,
)
from madviz.session.replay import replay_episode
from madviz.session.session_file import SavedPolicy
from madviz.session.session_reader import LONGEST, parse, read_session
from tests.fakes import FakePolicy
from tests.visitors import find, played, put


@cache
def document() -> dict[str, Any]:
    session = played(2, 20)
    return json.loads(replace(session, episodes=session.episodes[-1:]).to_json())


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("schema", 2),
        ("schema", True),
        ("episodes", []),
        ("episodes", {}),
        ("surprise", 1),
        ("versions", []),
        ("versions", {"numpy": 2}),
        ("versions", {"x\n": "1"}),
        ("episodes.0.seed", -1),
        ("episodes.0.seed", 2**31),
        ("episodes.0.seed", 1.0),
        ("episodes.0.seed", True),
        ("episodes.0.steps", 0),
        ("episodes.0.steps", 10**30),
        *[("episodes.0.policy.name", name) for name in ("a/b", "os:system", "..", "", "x" * 200)],
        ("episodes.0.policy.digest", "<b>"),
        ("episodes.0.policy.extra", ""),
        ("episodes.0.task", "../../etc"),
        ("episodes.0.task", 3),
        ("episodes.0.task", "recording/../etc"),
        ("episodes.0.cameras.0.name", "third a"),
        ("episodes.0.render_profile", "best"),
        ("episodes.0.ended", "yes"),
        ("episodes.0.cameras", []),
        ("episodes.0.cameras.0.name", "third_a"),
        ("episodes.0.cameras.0.fovy", 1e999),
        ("episodes.0.cameras.0.fovy", 0),
        ("episodes.0.cameras.0.position", [0, 0]),
        ("episodes.0.cameras.0.wxyz", [0, 0, 0, 0]),
        ("episodes.0.cameras.0.position", [0, 0, 1e9]),
        ("episodes.0.cameras.0.size", 10**6),
        ("episodes.0.cameras.0.depth_range", [2, 1]),
        ("episodes.0.cameras.0.size", 84.5),
        ("episodes.0.cameras.0.body", 5),
        ("episodes.0.cameras.0.label", "a\u0000"),
        ("episodes.0.start", [{"camera": "fourth", "input": "off"}]),
        ("episodes.0.start", [{"camera": "first", "input": "gone"}]),
        ("episodes.0.start", [{"camera": "first", "input": "off", "step": 0}]),
        ("episodes.0.start", [{"camera": "first", "input": "rgb", "occlusion": {"kind": "rain"}}]),
        ("episodes.0.commands", [{"camera": "first", "input": "off"}]),
        ("episodes.0.commands", [{"step": 9999, "camera": "first", "input": "off"}]),
        ("episodes.0.commands", [{"step": 0, "policy": "a/b", "digest": ""}]),
        ("episodes.0.commands", [{"step": 1, "policy": "a", "digest": "", "camera": "first"}]),
        ("episodes.0.commands", [[]]),
        ("episodes.0.commands", [{"step": s, "policy": "a", "digest": ""} for s in (2, 1)]),
        ("episodes.0.sha256.actions", "0" * 63),
        ("episodes.0.trace", "0"),
    ],
)
def test_a_file_that_will_not_do_is_refused_in_one_line(path: str, value: Any) -> None:
    content = json.dumps(put(document(), path, value)).encode()
    with pytest.raises(UserError) as refused:
        parse(content, "saved.json")
    line = str(refused.value)
    assert re.match("saved.json: (expected .+, found .+|unknown word .+; known: .+); save", line)
    assert "\n" not in line and len(line) < 400


def test_names_that_a_visitor_may_give_are_read() -> None:
    """A visitor names folders of recordings, and cameras in tasks of one's own."""
    for task in ("recording/svla_so101", "recording/Möbel 2", "lab.bench:Task"):
        assert parse(json.dumps(put(document(), "episodes.0.task", task)).encode(), "x")
    wrist = json.dumps(document()).replace('"first"', '"Wrist"')
    assert parse(wrist.encode(), "x").episodes[0].cameras[0].name == "Wrist"
    saved = SavedPolicy.of(replace(FakePolicy().spec, name="a/b", digest="recorded:plain"))
    assert saved == SavedPolicy("a-b", "recorded-plain")


def test_a_file_from_before_patches_had_two_sides_has_squares() -> None:
    patch = {"kind": "patch", "strength": 1.0, "x": 0.2, "y": 0.5, "size": 0.3}
    start = [{"camera": "first", "input": "rgb", "occlusion": patch}]
    read = parse(json.dumps(put(document(), "episodes.0.start", start)).encode(), "old.json")
    square = Occlusion("patch", x=0.2, width=0.3, height=0.3)
    assert read.episodes[0].start == (SetCamera("first", CameraState("rgb", square)),)
    assert parse(read.to_json().encode(), "new.json") == read
    for wrong in ({"width": 0.3}, {"width": 0.3, "height": 2.0}, {"size": "0.3"}):
        without = {key: value for key, value in patch.items() if key != "size"}
        start[0]["occlusion"] = without | wrong
        with pytest.raises(UserError, match=r"old.json: expected '?episodes\[0\]"):
            parse(json.dumps(put(document(), "episodes.0.start", start)).encode(), "old.json")
    start[0]["occlusion"] = patch | {"width": 0.3, "height": 0.3}
    with pytest.raises(UserError, match="width and height, or size"):
        parse(json.dumps(put(document(), "episodes.0.start", start)).encode(), "old.json")


def test_files_that_are_no_saved_session_at_all(tmp_path: Path) -> None:
    for content in (b"", b"\xff\xfe", b"[" * 100_000, b"NaN", b"5", b'{"schema": 1, "schema": 1}'):
        with pytest.raises(UserError):
            parse(content, "x")
    long = tmp_path / "long.json"
    long.write_bytes(b" " * (LONGEST + 1))
    for path in (long, tmp_path, tmp_path / "none.json"):
        with pytest.raises(UserError) as refused:
            read_session(path)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("episodes.0.ended", True, "expected 25 decisions"),
        ("episodes.0.task", "toy/leap", "unknown task"),
        ("episodes.0.policy.name", "nobody", "unknown policy"),
        ("episodes.0.cameras.0.fovy", 33, "toy/reach has the cameras"),
    ],
)
def test_a_file_that_cannot_be_replayed_here_says_why(path: str, value: Any, words: str) -> None:
    saved = parse(json.dumps(put(document(), path, value)).encode(), "x")
    with pytest.raises(UserError, match=words):
        replay_episode(saved.episodes[0], find)
