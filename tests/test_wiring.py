"""madviz wiring: what is wrong in a wire file is named, and what is right is left alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from madviz.cli import main
from madviz.errors import UserError
from madviz.examples.own_policy import Finder
from madviz.measure.wiring import confirm
from madviz.measure.wiring.candidates import candidates
from madviz.measure.wiring.check import WiringConfig, run_wiring, wiring
from madviz.measure.wiring.confirm import Comparison, compared
from madviz.measure.wiring.screen import CLOSER, FIRST_LOOKS, MOST, Screened, going_on
from madviz.policies.checkpoint import load_policy
from madviz.wire.reference import with_wire
from madviz.wire.wiring import Wiring, checked, env_of, read_wiring
from tests.wires import foreign_server, wiring_file
from tests.wiring_faults import FAULTS, NONE, POLICY, Fault, judged, misunderstood, said_of

# --- The rule ---


def outcomes(text: str) -> confirm.Played:
    return lambda scene: text[scene] == "1"


@pytest.mark.parametrize(
    ("before", "after", "verdict", "n"),
    [
        ("0" * 10, "1" * 10, "helps", 6),
        ("0100000000", "1111110111", "helps", 8),
        ("0000000001", "1111100110", "helps", 8),
        ("0000010000", "1111101111", "cannot tell", 6),
        ("1" * 10, "1" * 10, "cannot tell", 5),
        ("0" * 10, "0" * 10, "no better", 5),
        ("1" * 10, "0" * 10, "no better", 1),
        ("1010101010", "1110101010", "cannot tell", 6),
        ("1010101010", "1010101010", "no better", 5),
    ],
)
def test_a_change_helps_where_it_wins_six_scenes_before_it_loses_one(before, after, verdict, n):
    found = compared(outcomes(before), outcomes(after))
    assert (found.verdict, found.n) == (verdict, n)
    assert found.n <= confirm.MOST_SCENES


@pytest.mark.parametrize("rate", [0.2, 0.4, 0.5, 0.6, 0.7, 0.9])
def test_changes_that_make_no_difference_are_seldom_advised(rate):
    """All three that go on, whatever the screen chose, on the same scenes as wired."""
    rng = np.random.default_rng(0)
    runs = 4000
    advised = 0
    for _ in range(runs):
        scenes = rng.random((1 + MOST, confirm.MOST_SCENES)) < rate
        before, *changes = [lambda scene, row=row: bool(row[scene]) for row in scenes]
        advised += any(compared(before, change).verdict == "helps" for change in changes)
    assert advised / runs < 3 / 64


def test_a_change_that_mends_is_nearly_always_advised():
    rng = np.random.default_rng(0)
    found = [
        compared(outcomes("0" * 10), lambda scene: bool(rng.random() < 0.9)).verdict
        for _ in range(1000)
    ]
    assert found.count("helps") > 970 and "no better" not in found


def test_the_sentence_counts_what_was_played():
    assert Comparison(6, 0, 6, 6, 0).verdict == "helps"
    assert Comparison(6, 0, 7, 6, 1).verdict == "cannot tell"


# --- What is tried ---


def file_of(**words: Any) -> Wiring:
    cameras = {"first": "f", "third_a": "a", "third_b": "b"}
    table = {"task": "metaworld/hammer", "cameras": cameras, "size": 84, "state": "s"}
    return checked(Wiring(**{**table, "masks": True, **words}), "here")


@pytest.mark.parametrize(
    "words",
    [
        {},
        {"flip": "mirrored", "channels": "bgr", "values": "0-1", "action_scale": 10.0},
        {"size": [63, 84], "letterbox": True, "state_order": [16, 17, 18, 19]},
        {"size": {"first": 84, "third_a": 128, "third_b": 84}, "flip": {"first": "turned"}},
        {"state": "", "action_sign": [1, -1, 1, 1], "gripper_inverted": True},
        {"task": "maniskill/push-cube", "state_degrees": True},
        {"task": "toy/reach"},
    ],
)
def test_every_change_is_another_file_and_its_lines_say_it(words, tmp_path):
    as_wired = file_of(**words)
    tried = candidates(as_wired, env_of(as_wired))
    assert len(tried) > 20
    assert as_wired not in [candidate.wiring for candidate in tried]
    assert len({candidate.lines for candidate in tried}) == len(tried)
    for candidate in tried[:: max(len(tried) // 12, 1)]:
        said = {"task": f'"{as_wired.task}"', "cameras": None, "state": None, "size": None}
        lines = dict(line.split(" = ", 1) for line in candidate.lines.splitlines())
        for word in ("cameras", "size", "state", *words):
            said[word] = _written(getattr(as_wired, word))
        read = read_wiring(wiring_file(tmp_path, **{**said, **lines}))
        assert read == candidate.wiring, candidate.lines


def _written(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_written(each)}" for key, each in value.items()) + " }"
    return json.dumps(value)


def test_one_change_of_each_kind_goes_on_where_it_is_clearly_closer():
    tried = candidates(file_of(), env_of(file_of()))
    flips = [candidate for candidate in tried if candidate.kind == "flip"]
    signs = [candidate for candidate in tried if candidate.kind == "action sign"]
    swaps = [candidate for candidate in tried if candidate.kind == "cameras"]
    results = [
        Screened(flips[0], 0.2, 24),
        Screened(flips[1], 0.1, 24),
        Screened(flips[2], 0.01, FIRST_LOOKS),
        Screened(swaps[0], CLOSER * 0.4 + 0.01, 24),
        Screened(swaps[1], float("inf"), FIRST_LOOKS, "refused"),
        Screened(signs[0], 0.3004, 24),
        Screened(signs[1], 0.3001, 24),
    ]
    chosen = [result.candidate for result in going_on(results, 0.4)]
    assert chosen == [flips[1], signs[0]], "of those that are as close, the first"


# --- The whole, on the toy ---

TOY: dict[str, Fault] = {
    "BGR": FAULTS["BGR"],
    "sign": Fault(("action_sign = [1, -1]",), {}, action=lambda a: a * [1, -1]),
}


@pytest.mark.parametrize("fault", TOY.values(), ids=TOY)
def test_a_fault_is_named_and_nothing_else(fault):
    found, _ = said_of(Finder(), fault, 60000)
    assert judged(found, fault) == "right", found["sentence"]
    assert (
        found["sentence"].startswith("As wired: ") and "Try this in your wire" in found["sentence"]
    )


@pytest.mark.slow
def test_a_change_that_few_episodes_do_not_decide_is_named_as_undecided():
    """Finder finds its target in most scenes also where two of its cameras are swapped."""
    found, _ = said_of(Finder(), FAULTS["two cameras swapped"], 60000)
    assert judged(found, FAULTS["two cameras swapped"]) != "wrong"
    assert found["changes"][0]["label"] == "first and third_a swapped"
    assert "With first and third_a swapped: " in found["sentence"]


def test_the_command_says_that_nothing_is_wrong_and_leaves_the_file(tmp_path, capsys):
    with misunderstood(Finder(), NONE, tmp_path) as reference:
        address, _, file = reference.partition("#wire=")
        before = Path(file).read_bytes()
        out = tmp_path / "out.json"
        assert main(["wiring", "--policy", address, "--wire", file, "--json", str(out)]) == 0
        assert Path(file).read_bytes() == before
    document = json.loads(out.read_text())
    assert document["verdict"] == "as wired is best" and document["successes"] == document["n"] == 6


def test_a_policy_that_does_nothing_is_not_mended(tmp_path):
    with foreign_server(lambda look, _: {"actions": np.zeros(2)}) as address:
        policy = load_policy(with_wire(address, wiring_file(tmp_path)))
        found = wiring(policy)  # type: ignore[arg-type]
    assert found["verdict"] == "nothing does better" and found["successes"] == 0
    assert found["sentence"].startswith("As wired: 0 of 6. Nothing that was tried does better")


def test_a_policy_that_is_not_served_has_no_wire_file():
    with pytest.raises(UserError, match="expected ws://HOST:PORT of a policy that is served"):
        run_wiring(WiringConfig("madviz.examples.own_policy:make"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two cameras swapped", "state columns permuted", "action scale"])
def test_a_fault_of_a_trained_policy_is_named(name):
    found, _ = said_of(load_policy(POLICY), FAULTS[name], 61000)
    assert judged(found, FAULTS[name]) != "wrong", found["sentence"]
