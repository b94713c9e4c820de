"""Keys of a wire file: two that clash are refused, and all others arrive as they are written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from madviz.errors import UserError
from madviz.policies.checkpoint import load_policy
from madviz.wire.codec import Protocol
from madviz.wire.policy import ServedPolicy
from madviz.wire.reference import with_wire
from madviz.wire.wiring import read_wiring
from tests.wires import foreign_server, wiring_file

NAMES = ("first", "third_a", "third_b", "first.rgb", "first.depth", "third_a.depth")
ANSWER = np.array([0.25, 0.75])
WORDS = ("cam", "inner", "state", "noise", "prompt", "images", "task_description", "__ndarray__")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"cameras": '{ first = "cam", third_a = "cam" }'}, "first' and 'cameras.third_a' both at"),
        ({"cameras": '{ first = "cam", third_a = ["cam", "in"] }'}, "'cameras.third_a' both at"),
        ({"cameras": '{ first = ["cam", "in"], third_a = "cam" }'}, "'cameras.third_a' both at"),
        ({"cameras": '{ first = "cam" }', "state": '"cam"'}, "openpi.*'state' both at 'cam'"),
        ({"cameras": '{ first = "cam" }', "state": '["cam", "state"]'}, "'state' both at 'cam'"),
        ({"cameras": '{ first = "prompt" }'}, "openpi.*'instruction' and 'cameras.first' both at"),
        ({"state": '"task_description"'}, "vla-eval.*'instruction' and 'state' both at 'task_desc"),
        ({"state": '"images"', "protocol": '"vla-eval"'}, "'cameras.first' and 'state' both at"),
        ({"noise": '"front"'}, "'cameras.third_a' and 'noise' both at 'front'"),
        ({"noise": '"state"'}, "'state' and 'noise' both at 'state'"),
        ({"cameras": '{ first = "a", "first.rgb" = "b" }'}, "'cameras.first.rgb', which both send"),
        ({"cameras": '{ "first.depth.x" = "a" }'}, r"one with .rgb or .depth, found 'first.depth."),
        ({"cameras": '{ first = "" }'}, "'cameras.first' to be a key.* found an empty one"),
        ({"cameras": "{ first = [] }", "protocol": '"vla-eval"'}, "'cameras.first' to be a key"),
        ({"state": "[]"}, "'state' to be a key"),
        ({"state": str(["a"] * 20)}, "at most 8 tables deep, found 20"),
        ({"state": '"__ndarray__"'}, "'__ndarray__', which marks an array"),
        (
            {"modality": '{ "first.depth" = "rgb" }'},
            r"unknown camera in \[modality\] 'first.depth'",
        ),
    ],
)
def test_keys_that_clash_are_refused_when_the_file_is_read(changed, said, tmp_path):
    with pytest.raises(UserError, match=said) as refused:
        read_wiring(wiring_file(tmp_path, **changed))
    assert "\n" not in str(refused.value) and "wire.toml" in str(refused.value)


def test_a_file_that_says_its_protocol_need_not_fit_the_other(tmp_path):
    read_wiring(wiring_file(tmp_path, cameras='{ first = "prompt" }', protocol='"vla-eval"'))
    read_wiring(wiring_file(tmp_path, state='["images", "s"]', protocol='"vla-eval"'))


keys = st.one_of(
    st.sampled_from(WORDS),
    st.text(
        st.characters(min_codepoint=32, max_codepoint=400, exclude_characters="\x7f"), max_size=9
    ),
    st.lists(st.sampled_from(WORDS), max_size=3),
)
files = st.fixed_dictionaries(
    {
        "cameras": st.dictionaries(st.sampled_from(NAMES), keys, min_size=1, max_size=4),
        "state": keys,
        "noise": st.sampled_from(("", *WORDS)),
        "protocol": st.sampled_from((None, "openpi", "vla-eval")),
        "words": st.fixed_dictionaries(
            {},
            optional={
                "flip": st.sampled_from(("none", "upside-down", "mirrored", "turned")),
                "channels": st.sampled_from(("rgb", "bgr")),
                "values": st.sampled_from(("0-255", "0-1")),
                "state_order": st.lists(st.integers(0, 6), max_size=6),
                "state_scale": st.sampled_from((0.0, 1.0, 1000.0)),
                "action_order": st.sampled_from(([], [1, 0], [0, 1], [0])),
                "action_sign": st.sampled_from(([], [-1, 1])),
                "gripper_inverted": st.booleans(),
            },
        ),
    }
)


@pytest.fixture(scope="module")
def servers() -> Iterator[dict[Protocol, tuple[str, list[dict[str, Any]]]]]:
    """By protocol, the address of a server and the looks that it got."""
    with ExitStack() as stack:
        found: dict[Protocol, tuple[str, list[dict[str, Any]]]] = {}
        for protocol in ("openpi", "vla-eval"):
            looks: list[dict[str, Any]] = []

            def answer(look: dict[str, Any], _: object, kept: list = looks) -> dict[str, Any]:
                kept.append(look)
                return {"actions": ANSWER}

            address = stack.enter_context(foreign_server(answer, cast(Protocol, protocol)))
            found[cast(Protocol, protocol)] = address, looks
        yield found


def at(look: dict[str, Any], key: str | list[str]) -> Any:
    """The value that stands under ``key``."""
    for name in [key] if isinstance(key, str) else key:
        look = look[name]
    return look


@settings(
    max_examples=200,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(file=files)
def test_any_wire_file_is_refused_in_one_line_or_arrives_as_it_says(
    file: dict[str, Any], servers: dict[Protocol, tuple[str, list]], tmp_path: Path
) -> None:
    cameras = ", ".join(f"{json.dumps(n)} = {json.dumps(k)}" for n, k in file["cameras"].items())
    entries = {"state": file["state"], "noise": file["noise"], **file["words"]}
    written = {name: json.dumps(entry, ensure_ascii=False) for name, entry in entries.items()}
    protocol = file["protocol"] or "openpi"
    said = f'"{protocol}"' if file["protocol"] else None
    path = wiring_file(tmp_path, cameras=f"{{ {cameras} }}", protocol=said, **written)
    address, looks = servers[protocol]
    try:
        policy = cast(ServedPolicy, load_policy(with_wire(address, path)))
    except UserError as refused:
        assert "\n" not in str(refused) and "wire.toml" in str(refused)
        return
    looks.clear()
    views = np.random.default_rng(0).integers(0, 256, (len(file["cameras"]), 3, 84, 84), np.uint8)
    state = np.arange(6, dtype=np.float32)
    action = policy.read(policy.encode(views, state), np.ones(len(views), bool)).action[0]
    policy.close()
    (look,) = looks
    pictures = look["images"] if protocol == "vla-eval" else look
    words = file["words"]
    for view, (name, key) in zip(views, file["cameras"].items(), strict=True):
        found = at(pictures, key)
        if words.get("values") == "0-1":
            found = np.rint(found * 255).astype(np.uint8)
        if words.get("channels") == "bgr" and not name.endswith("depth"):
            found = found[..., ::-1]
        if words.get("flip") in ("upside-down", "turned"):
            found = found[::-1]
        if words.get("flip") in ("mirrored", "turned"):
            found = found[:, ::-1]
        np.testing.assert_array_equal(found, view.transpose(1, 2, 0))
    if file["state"] != "":
        sent = state[words.get("state_order") or slice(None)] * words.get("state_scale", 1.0)
        np.testing.assert_array_equal(at(look, file["state"]), sent)
    expected = ANSWER[words.get("action_order") or [0, 1]] * (words.get("action_sign") or 1)
    np.testing.assert_allclose(action, expected)
    if file["noise"]:
        assert look[file["noise"]] == 0
    instruction = look["prompt" if protocol == "openpi" else "task_description"]
    assert instruction == policy.spec.instruction
