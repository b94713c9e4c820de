"""Lesson 6: success with cameras missing, the file it is saved in, and how each merge acts."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from madviz import teaching
from madviz.agent.merges.merge_table import MERGES
from madviz.agent.methods import METHODS
from madviz.errors import UserError
from madviz.measure.statistics import pair
from madviz.subsets import mask_of
from madviz.system.files import read_json
from madviz.teaching import baselines
from madviz.teaching.baselines import on_robot, run_cases
from madviz.teaching.lessons import untrained
from madviz.teaching.merges import attention_shares
from madviz.teaching.outcomes import (
    CAMERAS,
    COMPARED,
    EPISODES,
    by_seed,
    cases,
    counted,
    one_missing,
    outcome_bars,
    outcome_table,
    read_outcomes,
    save_outcomes,
)
from tests.evidence import write_policy
from tests.fakes import AllOrNothing, FakePolicy


def test_every_camera_is_missing_in_every_way() -> None:
    assert len(cases()) == 1 + 3 * len(CAMERAS)
    assert cases()["third_a dropped"] == (("first", "third_b"), "")
    assert cases()["third_a black"] == (CAMERAS, "third_a")
    assert cases()["only third_a"] == (("third_a",), "")


def test_outcomes_are_those_of_the_evaluation() -> None:
    found = run_cases(FakePolicy(), ["all", "first dropped", "first black"], episodes=3)
    assert {len(digits) for digits in found.values()} == {3}
    policy = FakePolicy()
    last = [list(teaching.moments(policy, seed))[-1].success for seed in (5000, 5001, 5002)]
    assert found["all"] == "".join(str(int(success)) for success in last)


def test_cases_that_a_policy_refuses_are_left_out() -> None:
    found = run_cases(AllOrNothing(), episodes=1)
    assert list(found) == ["all", "first black", "third_a black", "third_b black"]


def test_a_camera_that_the_policy_never_had_changes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[str, dict]] = []
    whole = baselines.evaluate

    def evaluate(policy, subsets, **options):
        asked.append((*subsets, options["occlusions"]))
        return whole(policy, subsets, **options)

    monkeypatch.setattr(baselines, "evaluate", evaluate)
    found = run_cases(untrained("single"), episodes=1)
    assert [(subset, list(black)) for subset, black in asked] == [
        ("first", []),
        ("first", ["first"]),
    ]
    assert found["all"] == found["third_a dropped"] == found["third_b black"] == found["only first"]
    assert "first dropped" not in found and "only third_a" not in found


def test_saved_outcomes_stay_when_another_method_is_added(tmp_path: Path) -> None:
    file = tmp_path / "baselines.json"
    save_outcomes(file, "vib", {"all": "11"})
    save_outcomes(file, "mad", {"all": "10"})
    save_outcomes(file, "vib", {"all": "01", "only first": "00"})
    assert read_outcomes(file) == {"mad": {"all": "10"}, "vib": {"all": "01", "only first": "00"}}
    assert list(read_outcomes(file)) == ["mad", "vib"], "in the order of the tables"


def test_methods_are_compared_seed_by_seed() -> None:
    measured = {"a": {"all": "1101"}, "b": {"all": "1000", "only first": "0000"}}
    assert by_seed("1101") == {5000: True, 5001: True, 5002: False, 5003: True}
    paired = pair(by_seed(measured["a"]["all"]), by_seed(measured["b"]["all"]))
    assert (paired.both, paired.first_only, paired.second_only, paired.neither) == (1, 2, 0, 1)
    assert counted(measured, "only first") == {"b": (0, 4)}


def test_a_camera_is_missing_in_the_way_that_suits_the_method() -> None:
    black = {f"{camera} black": "00" for camera in CAMERAS}
    measured = {
        "concat": {"all": "11", **black},
        "sum": {"all": "11", **black, "first dropped": "10"},
    }
    best = one_missing(measured)
    assert [best[name]["first missing"] for name in measured] == ["00", "10"]
    assert list(best["sum"]) == ["all", "first missing", "third_a missing", "third_b missing"]


def test_a_refusal_is_written_in_the_table_and_has_no_bar() -> None:
    measured = {"a": {"all": "1101"}, "b": {"all": "1111", "only first": "0001"}}
    rows = {row[0]: row[1:] for row in outcome_table(measured, ["all", "only first"]).rows}
    assert rows["a"] == ("0.75 [0.30, 0.95] n=4", "refuses")
    both = outcome_bars("t", measured, ["all", "only first"]).svg
    one = outcome_bars("t", measured, ["all"]).svg
    assert both.count('class="bar"') == one.count('class="bar"') + 1


def shares(name: str, subset: str) -> dict[str, list[float]]:
    moment = teaching.moment_at(FakePolicy(), step=1)
    return {
        row[0]: [float(x) for x in row[1:]]
        for row in attention_shares(untrained(name), moment, subset).rows
    }


def test_no_view_attends_to_a_dropped_camera() -> None:
    for name in ("vit", "attention"):
        left = shares(name, "first+third_b")
        assert list(left) == ["First person", "Third B"]
        assert all(
            given[1] == 0 and sum(given) == pytest.approx(1, abs=0.02) for given in left.values()
        )
        assert all(given[1] > 0.1 for who, given in shares(name, "all").items() if who != "Third A")
    assert shares("attention", "first+third_b")["First person"] == [0, 0, 1], (
        "it asks the others only"
    )
    assert shares("attention", "first") == {"First person": [0, 0, 0]}
    assert shares("vit", "first") == {"First person": [1, 0, 0]}
    with pytest.raises(UserError, match="attends"):
        shares("mad", "all")


def test_reading_the_attention_leaves_no_hook() -> None:
    policy, moment = untrained("vit"), teaching.moment_at(FakePolicy(), step=1)
    attention_shares(policy, moment, "all")
    pickle.dumps(policy.agent)  # A hook that is left cannot be pickled.


def test_what_ships_is_whole_and_agrees_with_the_merges() -> None:
    measured = read_outcomes()
    assert tuple(measured) == COMPARED
    for name, outcomes in measured.items():
        assert {len(digits) for digits in outcomes.values()} == {EPISODES}
        if not METHODS[name].one_camera:
            allows = MERGES[METHODS[name].merge].support.allows
            for case, (cameras, _) in cases().items():
                assert (case in outcomes) == allows(mask_of("+".join(cameras), CAMERAS))


def test_baselines_on_a_robot_share_one_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    everywhere = {"all": 0.9, "first": 0.8, "third_a": 0.7, "third_b": 0.6}
    write_policy(tmp_path, everywhere, episodes=10)
    write_policy(tmp_path, {"all": 0.5}, method="concat", merge="concat", episodes=10)
    write_policy(tmp_path, {"all": 0.4}, method="single", setting="one-rgb", episodes=10,
                 streams=("third_a",), folder="alone")  # fmt: skip
    write_policy(tmp_path, everywhere, method="vib", merge="vib", updates=9, episodes=10)
    write_policy(tmp_path, everywhere, method="mvd", task="metaworld/push", episodes=10)
    monkeypatch.setenv("MADVIZ_CHECKPOINTS", str(tmp_path))
    found = on_robot("metaworld/hammer")
    assert {name: list(outcomes) for name, outcomes in found.items()} == {
        "mad": list(everywhere), "single": ["third_a"], "concat": ["all"]
    }  # fmt: skip
    assert counted(found, "third_a") == {"mad": (7, 10), "single": (4, 10)}
    # Episode by episode, in the order of seeds.
    saved = read_json(tmp_path / "metaworld-hammer-mad-light" / "evaluation.json")["episodes"]
    digits = {e["seed"]: str(int(e["success"])) for e in saved if e["subset"] == "first"}
    assert found["mad"]["first"] == "".join(digits[seed] for seed in sorted(digits))
    assert [row[1] for row in outcome_table(found, ["all"], missing="–").rows] == [
        "0.90 [0.60, 0.98] n=10",
        "–",
        "0.50 [0.24, 0.76] n=10",
    ]
    with pytest.raises(UserError, match="results for toy/reach, found none"):
        on_robot("toy/reach")


def test_the_shipped_baselines_on_push_have_the_same_seeds() -> None:
    found = on_robot("metaworld/push")
    assert {"mad", "single", "vib", "merged-only", "singular-only"} <= found.keys()
    assert {len(digits) for outcomes in found.values() for digits in outcomes.values()} == {50}
